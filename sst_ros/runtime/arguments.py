# SPDX-License-Identifier: Apache-2.0
"""Command lines of the nodes, read without ROS: plain options become ROS arguments.

Every parameter is a plain option, beside ROS arguments. What is wrong with those other
than the name of a parameter, `rclpy.init` says: --help and a misspelt option need no
ROS.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from sst_ros.errors import Check, refuse_errors, refuse_unless, suggestion
from sst_ros.removed import REMOVED_ARGUMENTS
from sst_ros.runtime.settings import NODE_COMMANDS
from sst_ros.scene.schema import Spec, accept
from sst_ros.scene.yaml_document import read_file, read_values

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
USE_SIM_TIME = "use_sim_time"
FOREIGN = (USE_SIM_TIME, "start_type_description_service", "qos_overrides.")
"""Parameters (or their beginning) that rclpy itself declares."""


def make_parser(command: str) -> argparse.ArgumentParser:
    """Make the parser of plain options.

    It leaves words to be checked, so that all are.
    """
    parser = argparse.ArgumentParser(
        prog=command,
        usage="%(prog)s [--PARAMETER VALUE ...] [--ros-args ROS_ARGUMENT ...]",
        description=(
            f"Node sst_{command}. Parameters, also as `--ros-args -p NAME:=VALUE`:"
        ),
        add_help=False,
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
    )
    defaults = NODE_COMMANDS[command][1]()
    for name, spec in _specs_of(command).items():
        default = getattr(defaults, name, False)
        if isinstance(default, (bool, tuple)):
            default = json.dumps(default)
        text = f"{spec.doc}; {spec.describe()}; default: {default}"
        parser.add_argument(
            _option(name),
            nargs="?",
            const="true" if spec.kind == "flag" else "",  # of an option without a value
            metavar="VALUE",
            help=text.replace("%", "%%"),  # argparse would fill in %
        )
    return parser


def ros_arguments(command: str, arguments: Sequence[str]) -> list[str]:
    """Return the words (without the program's name) as ROS arguments.

    An InputError lists every plain option, value and name of a parameter that is
    refused.
    """
    specs = _specs_of(command)
    plain: list[str] = []
    ros: list[str] = []
    destination = plain
    for argument in arguments:  # as rcl sorts them
        if argument == "--ros-args":
            destination = ros
        elif argument == "--" and destination is ros:
            destination = plain
        else:
            destination.append(argument)
    # A parameter is an option by its name, too: --publish_rate.
    dashed = [
        re.sub("^--[^=]*", lambda option: option[0].replace("_", "-"), argument)
        for argument in plain
    ]
    options_given, unknown = make_parser(command).parse_known_args(dashed)
    checks: list[Check] = []
    for argument in unknown:
        option, *_ = re.split("[=:]", argument)
        checks.append(unknown_name(option, map(_option, specs)))
    for flag, rule in pairwise(ros):
        if flag in ("-p", "--param"):
            node_and_name, _, _ = rule.partition(":=")
            _, _, name = node_and_name.rpartition(":")
            if name not in specs and not name.startswith(FOREIGN):
                checks.append(unknown_name(name, specs))
        if flag == "--log-level":
            _, _, level = rule.rpartition(":=")
            requirement = f"must be one of {', '.join(LOG_LEVELS)}"
            checks.append((flag, level, level.lower() in LOG_LEVELS, requirement))
    options: list[str] = []
    for name, argument in vars(options_given).items():
        spec = specs[name]
        try:
            options += ["-p", f"{name}:={_as_yaml(spec, argument)}"]
        except ValueError:
            needs = "" if argument else "needs a value, which "
            checks.append(
                (_option(name), argument or None, False, needs + spec.describe())
            )
    refuse_unless(command, *checks)
    if not ros and not options:
        return []
    return ["--ros-args", *ros, *options]


def unknown_name(name: str, valid_names: Iterable[str]) -> Check:
    """Return the failed check of a name that is no parameter or option."""
    names = [*valid_names]
    advice = REMOVED_ARGUMENTS.get(name.lstrip("-"))
    if advice is not None:
        return "parameter", name, False, advice
    hint = suggestion(name, names) or f"; known are {', '.join(names)}"
    refused = "is no parameter of the node"
    if name.startswith("-"):
        return "argument", name, False, f"{refused}, unless behind --ros-args{hint}"
    return "parameter", name, False, f"{refused}{hint}"


def unused_files(ros: Sequence[str], node: str) -> Iterator[str]:
    """Yield a line for each parameter file without parameters for this node.

    The node is given by its full name. The files are those that rcl has read from the
    ROS arguments.
    """
    for flag, path in pairwise(ros):
        if flag != "--params-file":
            continue
        requirement = "must be a readable file"
        with refuse_errors(
            node, "--params-file", path, requirement, OSError, ValueError
        ):
            text = read_file(Path(path))
        patterns = [*_nodes_of(read_values(text, path))]
        # ** stands for any number of names, * for one.
        forms = [
            re.escape(pattern).replace(r"/\*\*", "(/[^/]+)*") for pattern in patterns
        ]
        if not any(
            re.fullmatch(form.replace(r"/\*", "/[^/]+"), node) for form in forms
        ):
            names = ", ".join(patterns) or "none"
            yield (
                f"{path} has no parameters for {node}, only for {names} (/** is any"
                " node)"
            )


def _nodes_of(tree: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names of the nodes that a parameter file has parameters for."""
    for key, inner in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters":
            yield prefix
        else:
            yield from _nodes_of(inner, f"{prefix}/{key.strip('/')}")


def _specs_of(command: str) -> dict[str, Spec]:
    return {
        **NODE_COMMANDS[command][1].SPECS,
        USE_SIM_TIME: Spec("flag", "follow /clock"),
    }


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _as_yaml(spec: Spec, text_given: str) -> str:
    """Return a value as rcl reads it, or raise ValueError."""
    value: Any = text_given.strip()
    if spec.shape or spec.kind == "texts":
        value = _read_list(value)
    text = json.dumps(accept(spec, value), ensure_ascii=False)
    if spec.kind == "number":  # YAML 1.1 reads 1e-9 as text
        return re.sub(r"(?<![\d.])(\d+)e", r"\1.0e", text)
    return text


def _read_list(text: str) -> list[str]:
    """Read a list with or without brackets.

    Its entries may be quoted as in JSON or YAML.
    """
    inner = text.strip()
    if inner.startswith("[") and inner.endswith("]"):
        inner = inner[1:-1]
    return [_unquote(entry.strip()) for entry in inner.split(",")]


def _unquote(text: str) -> str:
    """Return a text without the quotes around it, if there are any."""
    if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    return text
