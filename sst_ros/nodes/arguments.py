# SPDX-License-Identifier: Apache-2.0
"""Command line of a node: every parameter as a plain option, --help, and ROS arguments.

Imports no ROS: `--help` and a misspelt option need none. What is wrong with ROS arguments other
than the name of a parameter, `rclpy.init` says.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from sst_ros.errors import Check, refuse_unless, suggestion
from sst_ros.runtime import settings
from sst_ros.scene.schema import Section, Spec, accept

USE_SIM_TIME = "use_sim_time"
FOREIGN = (USE_SIM_TIME, "start_type_description_service", "qos_overrides.")
"""Parameters (or their beginning) that rclpy itself declares."""

COMMANDS: dict[str, tuple[str, type[Section]]] = {
    "simulator": ("Simulator", settings.SimulatorParameters),
    "torque_player": ("TorquePlayer", settings.PlayerParameters),
    "inverse_dynamics": ("InverseDynamicsController", settings.ControllerNodeParameters),
    "recorder": ("Recorder", settings.RecorderParameters),
    "viewer": ("Viewer", settings.ViewerParameters),
}
"""Class of `nodes.COMMAND` that does the work of each node sst_COMMAND, and its parameters."""


def make_parser(command: str) -> argparse.ArgumentParser:
    """Make the parser of plain options; it leaves words to be checked, so that all are."""
    parser = argparse.ArgumentParser(
        prog=command,
        usage="%(prog)s [--PARAMETER VALUE ...] [--ros-args ROS_ARGUMENT ...]",
        description=f"Node sst_{command}. Parameters, also as `--ros-args -p NAME:=VALUE`:",
        add_help=False,
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
    )
    defaults = COMMANDS[command][1]()
    for name, spec in _specs_of(command).items():
        value = getattr(defaults, name, False)
        shown = json.dumps(value) if isinstance(value, (bool, tuple)) else value
        text = f"{spec.doc}; {spec.describe()}; default: {shown}".replace("%", "%%")
        word = "true" if spec.kind == "flag" else ""  # of an option without a value
        parser.add_argument(_option(name), nargs="?", const=word, metavar="VALUE", help=text)
    return parser


def ros_arguments(command: str, words: Sequence[str]) -> list[str]:
    """Return the words (without the program's name) as ROS arguments.

    An InputError lists every plain option, value and name of a parameter that is refused.
    """
    known, plain, ros = _specs_of(command), list[str](), list[str]()
    here = plain
    for word in words:  # as rcl sorts them
        if word == "--ros-args":
            here = ros
        elif word == "--" and here is ros:
            here = plain
        else:
            here.append(word)
    # A parameter is an option by its name, too: --publish_rate.
    dashed = [re.sub("^--[^=]*", lambda m: m[0].replace("_", "-"), word) for word in plain]
    given, unknown = make_parser(command).parse_known_args(dashed)
    named = [re.split("[=:]", word)[0] for word in unknown]
    checks = [unknown_name(word, map(_option, known)) for word in named]
    for flag, rule in pairwise(ros):
        name = rule.partition(":=")[0].rpartition(":")[2]
        if flag in ("-p", "--param") and name not in known and not name.startswith(FOREIGN):
            checks.append(unknown_name(name, known))
    options: list[str] = []
    for name, word in vars(given).items():
        spec = known[name]
        try:
            options += ["-p", f"{name}:={_as_yaml(spec, word)}"]
        except ValueError:
            needs = "" if word else "needs a value, which "
            checks.append((_option(name), word or None, False, needs + spec.describe()))
    refuse_unless(command, *checks)
    return ["--ros-args", *ros, *options] if ros or options else []


def unknown_name(name: str, known: Iterable[str]) -> Check:
    """Return the failed check of a name that is no parameter or option."""
    names = [*known]
    near = suggestion(name, names) or f"; known are {', '.join(names)}"
    behind = ", unless behind --ros-args" if name.startswith("-") else ""
    return name, name, False, f"is no parameter of the node{behind}{near}"


def unused_files(ros: Sequence[str], node: str) -> Iterator[str]:
    """Yield a line for each parameter file without parameters for the node of this full name.

    The files are those that rcl has read from the ROS arguments.
    """
    for path in (path for flag, path in pairwise(ros) if flag == "--params-file"):
        text = Path(path).read_text(encoding="utf-8", errors="replace")
        patterns = [*_nodes_of(yaml.load(text, yaml.BaseLoader))]
        # ** stands for any number of names, * for one.
        forms = [re.escape(one).replace(r"/\*\*", "(/[^/]+)*") for one in patterns]
        if not any(re.fullmatch(form.replace(r"/\*", "/[^/]+"), node) for form in forms):
            names = ", ".join(patterns) or "none"
            yield f"{path} has no parameters for {node}, only for {names} (/** is any node)"


def _nodes_of(tree: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names of the nodes that a parameter file has parameters for."""
    for key, inner in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters":
            yield prefix
        else:
            yield from _nodes_of(inner, f"{prefix}/{key.strip('/')}")


def _specs_of(command: str) -> dict[str, Spec]:
    return {**COMMANDS[command][1].SPECS, USE_SIM_TIME: Spec("flag", "follow /clock")}


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _as_yaml(spec: Spec, word: str) -> str:
    """Return a value as rcl reads it, or raise ValueError."""
    value: Any = word.strip()
    if spec.shape or spec.kind == "texts":
        value = [part.strip() for part in word.strip("[]").split(",")]
    text = json.dumps(accept(spec, value), ensure_ascii=False)
    # YAML 1.1 reads 1e-9 as text.
    return re.sub(r"(?<![\d.])(\d+)e", r"\1.0e", text) if spec.kind == "number" else text
