# SPDX-License-Identifier: Apache-2.0
"""Command line of a node: every parameter as a plain option, --help, and ROS arguments, checked.

Imports no ROS: `--help` and a misspelt option need none.
"""

from __future__ import annotations

import difflib
import json
import re
import textwrap
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from sst_ros.errors import InputError, Problem
from sst_ros.runtime import settings
from sst_ros.scene.schema import Section, Spec, accept, specs

USE_SIM_TIME = "use_sim_time"
_FOREIGN = (USE_SIM_TIME, "start_type_description_service", "qos_overrides.")
"""Parameters (or their beginning) that rclpy itself declares."""

_WITH_VALUE = (
    *("-p", "--param", "--params-file", "-r", "--remap", "-e", "--enclave"),
    *("--log-level", "--log-config-file", "--log-file-name"),
)
_FLAGS = re.compile(r"--(enable|disable)-(rosout|stdout|external-lib)-logs")
_YAML = {True: "true", False: "false"}


COMMANDS: dict[str, tuple[str, type[Section]]] = {
    "simulator": ("Simulator", settings.SimulatorParameters),
    "torque_player": ("TorquePlayer", settings.PlayerParameters),
    "inverse_dynamics": ("InverseDynamicsController", settings.ControllerNodeParameters),
    "recorder": ("Recorder", settings.RecorderParameters),
    "viewer": ("Viewer", settings.ViewerParameters),
}
"""Class of `nodes.COMMAND` that does the work of each node sst_COMMAND, and its parameters."""


def wants_help(words: Sequence[str]) -> bool:
    """Whether the words (without the program's name) ask for help."""
    return "-h" in words or "--help" in words


def help_text(command: str) -> str:
    """Return the parameters of a node with defaults, units and bounds."""
    _, parameters = COMMANDS[command]
    defaults = parameters()
    text = [
        f"usage: {command} [--PARAMETER VALUE ...] [--ros-args ROS_ARGUMENT ...]",
        "",
        f"Node sst_{command}. Parameters, also as `--ros-args -p NAME:=VALUE`:",
        "",
    ]
    for name, spec in specs(parameters).items():
        value = getattr(defaults, name)
        shown = json.dumps(value) if isinstance(value, (bool, tuple)) else value
        text.append(f"  --{name.replace('_', '-')}")
        about = f"{spec.doc}; {spec.allowed()}; default: {shown}"
        text += textwrap.wrap(about, 92, initial_indent=" " * 6, subsequent_indent=" " * 6)
    text.append("  --use-sim-time\n      follow /clock; must be true or false; default: false")
    return "\n".join(text)


def ros_arguments(command: str, words: Sequence[str]) -> list[str]:
    """Return the words (without the program's name) as ROS arguments.

    Raises:
        InputError: lists every word that is no argument of the node, with the closest one.

    """
    known = {**specs(COMMANDS[command][1]), USE_SIM_TIME: Spec("flag", "follow /clock")}
    plain, ros = _split(words)
    problems = [*_faults(ros, known)]
    options: list[str] = []
    index = 0
    while index < len(plain):
        word, index = plain[index], index + 1
        name, equals, value = word.partition("=")
        key = name.removeprefix("--").replace("-", "_")
        if not name.startswith("--") or key not in known:
            problems.append(Problem(word, word, _advice(word, key, known)))
            continue
        spec = known[key]
        if not equals:
            following = plain[index] if index < len(plain) else None
            if spec.kind == "flag" and following not in _YAML.values():
                value = "true"
            elif following is None or following.startswith("--"):
                problems.append(Problem(word, None, f"needs a value, which {spec.allowed()}"))
                continue
            else:
                value, index = following, index + 1
        try:
            options += ["-p", f"{key}:={_as_yaml(spec, value)}"]
        except ValueError:
            problems.append(Problem(word, value, spec.allowed()))
    if problems:
        raise InputError(command, problems)
    return ["--ros-args", *ros, *options] if ros or options else []


def params_file_warnings(command: str, words: Sequence[str]) -> list[str]:
    """Return one line for each parameter file that has no parameters for the node of the words."""
    node, namespace = f"sst_{command}", ""
    _, ros = _split(words)
    for rule in _values(ros, ("-r", "--remap")):
        if found := re.fullmatch(r"(?:[^:]*:)?__(node|name|ns):=(.+)", rule):
            if found[1] == "ns":
                namespace = found[2].strip("/")
            else:
                node = found[2]
    full = "/" + "/".join(filter(None, (namespace, node)))
    lines = []
    for path in _values(ros, ("--params-file",)):
        patterns = ["/" + pattern.strip("/") for pattern in _nodes_of(_document(path))]
        if not any(_matches(pattern, full) for pattern in patterns):
            names = ", ".join(patterns)
            lines.append(f"{path} has no parameters for {full}, only for {names} (/** is any node)")
    return lines


def known_anywhere() -> set[str]:
    """Names of the parameters of all nodes: they may share a parameter file."""
    return {name for _, parameters in COMMANDS.values() for name in specs(parameters)}


def is_foreign(name: str) -> bool:
    """Whether rclpy itself declares a parameter of this name."""
    return name.startswith(_FOREIGN)


def unknown_parameter(name: str, known: Sequence[str]) -> Problem:
    """Return the fault of a name that is no parameter."""
    close = difflib.get_close_matches(name, known, 1)
    meant = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
    return Problem(name, name, f"is no parameter of the node: {meant}")


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Sort words into plain options and ROS arguments, as rcl does."""
    plain: list[str] = []
    ros: list[str] = []
    here = plain
    for word in words:
        if word == "--ros-args":
            here = ros
        elif word == "--" and here is ros:
            here = plain
        else:
            here.append(word)
    return plain, ros


def _faults(ros: Sequence[str], known: dict[str, Spec]) -> Iterator[Problem]:
    index = 0
    while index < len(ros):
        word, index = ros[index], index + 1
        if _FLAGS.fullmatch(word):
            continue
        name, equals, value = word.partition(":=")
        if name.startswith("--") and equals and name.split(":")[0] in _WITH_VALUE:
            word = name
        elif word in _WITH_VALUE and index < len(ros):
            value, index = ros[index], index + 1
        else:
            allowed = f"is no ROS argument: known are {', '.join(_WITH_VALUE)}"
            yield Problem(word, value or None, allowed)
            continue
        if word in ("-p", "--param"):
            key, assigned, _ = value.partition(":=")
            key = key.rpartition(":")[2]
            if not assigned:
                yield Problem(word, value, "must be NAME:=VALUE")
            elif key not in known and not is_foreign(key):
                yield unknown_parameter(key, [*known])
        elif word == "--params-file":
            try:
                if not [*_nodes_of(_document(value))]:
                    raise ValueError("no ros__parameters")
            except (OSError, ValueError, yaml.YAMLError) as error:
                reason = str(error).splitlines()[0]
                allowed = "must be a parameter file, NODE: {ros__parameters: {NAME: VALUE}}"
                yield Problem(word, value, f"{allowed} ({reason})")


def _values(ros: Sequence[str], names: Sequence[str]) -> list[str]:
    return [value for word, value in pairwise(ros) if word in names]


def _document(path: str) -> Any:
    return yaml.safe_load(Path(path).read_text(encoding="utf-8"))


def _nodes_of(document: Any, prefix: str = "") -> Iterator[str]:
    """Names of the nodes that a parameter file has parameters for."""
    if not isinstance(document, dict):
        raise ValueError("no mapping")
    for key, value in document.items():
        name = f"{prefix}/{str(key).strip('/')}"
        if isinstance(value, dict) and isinstance(value.get("ros__parameters"), dict):
            yield name
        elif isinstance(value, dict):
            yield from _nodes_of(value, name)


def _matches(pattern: str, full: str) -> bool:
    parts = (
        {"**": r"(/[^/]+)*", "*": "/[^/]+"}.get(part, "/" + re.escape(part))
        for part in pattern.strip("/").split("/")
    )
    return re.fullmatch("".join(parts), full) is not None


def _advice(word: str, key: str, known: dict[str, Spec]) -> str:
    if word in ("-p", "-r", "--params-file", "--log-level", "--remap", "--param"):
        return "goes behind --ros-args"
    name = key.partition(":")[0].strip("_")
    close = difflib.get_close_matches(name, known, 1)
    if close and not word.startswith("--") and name == close[0]:
        return f"did you mean --{close[0].replace('_', '-')} VALUE?"
    options = [f"--{name.replace('_', '-')}" for name in (close or known)]
    return (
        f"did you mean {options[0]}?" if close else f"is no option: known are {', '.join(options)}"
    )


def _as_yaml(spec: Spec, word: str) -> str:
    """Return a value as rcl reads it.

    Raises:
        ValueError: it is none of the parameter.

    """
    value: Any = word
    if spec.kind == "flag":
        value = {"true": True, "false": False}.get(word.lower(), word)
    elif spec.kind == "integer":
        value = int(word)
    elif spec.kind == "number":
        numbers = [float(part) for part in word.strip("[]").split(",")]
        value = numbers if spec.shape else float(word)
    elif spec.kind == "texts":
        value = [part.strip() for part in word.strip("[]").split(",")]
    text = json.dumps(accept(spec, value), ensure_ascii=False)
    return re.sub(r"(?<![\d.])(\d+)e", r"\1.0e", text) if spec.kind == "number" else text
