# SPDX-License-Identifier: Apache-2.0
"""Command line of a node: every parameter as a plain option, --help, and ROS arguments, checked.

Imports no ROS: `--help` and a misspelt option need none.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from sst_ros.errors import InputError, Problem
from sst_ros.runtime import settings
from sst_ros.scene.schema import Section, Spec, Switch, accept

USE_SIM_TIME = "use_sim_time"
FOREIGN = (USE_SIM_TIME, "start_type_description_service", "qos_overrides.")
"""Parameters (or their beginning) that rclpy itself declares."""

_ROS = (
    *(("-p", "--param"), ("--params-file",), ("-r", "--remap"), ("-e", "--enclave")),
    *(("--log-level",), ("--log-config-file",), ("--log-file-name",)),
)
"""ROS arguments with a value, by all their names."""
_FLAGS = re.compile(r"--(enable|disable)-(rosout|stdout|external-lib)-logs")

COMMANDS: dict[str, tuple[str, type[Section]]] = {
    "simulator": ("Simulator", settings.SimulatorParameters),
    "torque_player": ("TorquePlayer", settings.PlayerParameters),
    "inverse_dynamics": ("InverseDynamicsController", settings.ControllerNodeParameters),
    "recorder": ("Recorder", settings.RecorderParameters),
    "viewer": ("Viewer", settings.ViewerParameters),
}
"""Class of `nodes.COMMAND` that does the work of each node sst_COMMAND, and its parameters."""


def help_text(command: str) -> str:
    """Return the parameters of a node with defaults, units and bounds."""
    return _parser(command).format_help().rstrip()


def ros_arguments(command: str, words: Sequence[str]) -> list[str]:
    """Return the words (without the program's name) as ROS arguments.

    An InputError lists every word that is no argument of the node, with the closest one.
    """
    known = _specs_of(command)
    plain, ros = _split(words)
    problems = [*_ros_faults(ros, known)]
    # A parameter is an option by its name, too: --publish_rate.
    dashed = [re.sub("^--[^=]*", lambda m: m[0].replace("_", "-"), word) for word in plain]
    given, unknown = _parser(command).parse_known_args(dashed)
    problems += [Problem(word, word, _advice(word, known)) for word in unknown]
    options: list[str] = []
    for name, word in vars(given).items():
        spec = known[name]
        try:
            options += ["-p", f"{name}:={_as_yaml(spec, word)}"]
        except ValueError:
            needs = "" if word else "needs a value, which "
            problems.append(Problem(_option(name), word or None, needs + spec.describe()))
    if problems:
        raise InputError(command, problems)
    return ["--ros-args", *ros, *options] if ros or options else []


def params_file_warnings(command: str, words: Sequence[str]) -> Iterator[str]:
    """Yield a line for each parameter file that has no parameters for the node of the words."""
    given, _ = _parse_ros(_split(words)[1])
    rules = [re.fullmatch(r"(?:[^:]*:)?__(node|name|ns):=(.+)", rule) for rule in given.remap]
    renamed = {rule[1].replace("name", "node"): rule[2] for rule in rules if rule}
    space, name = renamed.get("ns", "").strip("/"), renamed.get("node", f"sst_{command}")
    full = f"/{space}/{name}".replace("//", "/")
    for path in given.params_file:
        patterns = _nodes_of(path)
        # ** stands for any number of names, * for one.
        forms = [re.escape(one).replace(r"/\*\*", "(/[^/]+)*") for one in patterns]
        if not any(re.fullmatch(form.replace(r"/\*", "/[^/]+"), full) for form in forms):
            names = ", ".join(patterns)
            yield f"{path} has no parameters for {full}, only for {names} (/** is any node)"


def unknown_parameter(name: str, known: Sequence[str]) -> Problem:
    """Return the fault of a name that is no parameter."""
    close = difflib.get_close_matches(name, known, 1)
    meant = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
    return Problem(name, name, f"is no parameter of the node: {meant}")


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Sort words into plain options and ROS arguments, as rcl does."""
    here = plain = list[str]()
    ros = list[str]()
    for word in words:
        if word == "--ros-args":
            here = ros
        elif word == "--" and here is ros:
            here = plain
        else:
            here.append(word)
    return plain, ros


def _specs_of(command: str) -> dict[str, Spec]:
    return {**COMMANDS[command][1].SPECS, USE_SIM_TIME: Spec("flag", "follow /clock")}


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _parser(command: str) -> argparse.ArgumentParser:
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


def _parse_ros(words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return ROS arguments, each with all of its values, and the words that are none."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for names in _ROS:
        parser.add_argument(*names, nargs="?", action="append", default=[])
    return parser.parse_known_args(words)


def _ros_faults(ros: Sequence[str], known: dict[str, Spec]) -> Iterator[Problem]:
    given, unknown = _parse_ros(ros)
    listed = ", ".join(name for names in _ROS for name in names)
    for word in unknown:
        if not _FLAGS.fullmatch(word):
            yield Problem(word, None, f"is no ROS argument: known are {listed}")
    for name, values in vars(given).items():
        if None in values:
            yield Problem(_option(name), None, "needs a value")
    for value in filter(None, given.param):
        key, assigned, _ = value.partition(":=")
        key = key.rpartition(":")[2]
        if not assigned:
            yield Problem("-p", value, "must be NAME:=VALUE")
        elif key not in known and not key.startswith(FOREIGN):
            yield unknown_parameter(key, [*known])
    for path in filter(None, given.params_file):
        try:
            _nodes_of(path)
        except (OSError, ValueError, yaml.YAMLError) as error:
            reason = str(error).splitlines()[0]
            allowed = "must be a parameter file, NODE: {ros__parameters: {NAME: VALUE}}"
            yield Problem("--params-file", path, f"{allowed} ({reason})")


def _nodes_of(path: str) -> list[str]:
    """Names of the nodes that a parameter file has parameters for, of one at least."""
    document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise ValueError("no mapping")
    found, trees = list[str](), [("", document)]
    for prefix, tree in trees:  # which grows
        for key, value in tree.items():
            if isinstance(value, dict):
                name = f"{prefix}/{str(key).strip('/')}"
                if isinstance(value.get("ros__parameters"), dict):
                    found.append(name)
                else:
                    trees.append((name, value))
    if not found:
        raise ValueError("no ros__parameters")
    return found


def _advice(word: str, known: dict[str, Spec]) -> str:
    """Say what a word that is no option may have been meant as."""
    if any(word in names for names in _ROS):
        return "goes behind --ros-args"
    name = re.split("[=:]", word)[0].strip("-_").replace("-", "_")
    close = difflib.get_close_matches(name, known, 1)
    if not close:
        return f"is no option: known are {', '.join(map(_option, known))}"
    value = " VALUE" if name == close[0] and not word.startswith("--") else ""
    return f"did you mean {_option(close[0])}{value}?"


def _as_yaml(spec: Spec, word: str) -> str:
    """Return a value as rcl reads it, or raise ValueError."""
    value: Any = Switch(word) if spec.kind == "flag" else word.strip()
    if spec.shape or spec.kind == "texts":
        value = [part.strip() for part in word.strip("[]").split(",")]
    text = json.dumps(accept(spec, value), ensure_ascii=False)
    # rcl reads 1e-9 as text.
    return re.sub(r"(?<![\d.])(\d+)e", r"\1.0e", text) if spec.kind == "number" else text
