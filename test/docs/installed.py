# SPDX-License-Identifier: Apache-2.0
"""Commands that need what a plain machine has not: checked against what exists in the
tree.
"""

import re
import shlex
from functools import cache

import yaml
from builtin_interfaces.msg import Duration
from docs.blocks import ROOT
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.nodes.topics import EXECUTES, PUBLISHES, SERVES, SUBSCRIBES
from sst_ros.runtime.arguments import ros_arguments
from sst_ros.runtime.settings import NODE_COMMANDS
from tools.reference_pages import NODES

ENDPOINTS = {
    "topic": ("echo hz pub info bw delay", PUBLISHES, SUBSCRIBES),
    "service": ("call", SERVES),
    "action": ("send_goal", EXECUTES),
}
"""Verbs of a command of ros2, and what its names are to a node of ours."""
SETUP = (ROOT / "setup.py").read_text(encoding="utf-8")


@cache
def names(*uses):
    """Every topic or service of ours in the root namespace, with its type."""
    found = {}
    for node in NODES:
        for endpoint in node.endpoints:
            if endpoint.use in uses:
                name = endpoint.name.replace("~", f"/{node.name}")
                name = name.format(simulator="/sst_simulator")
                found[name if name.startswith("/") else f"/{name}"] = endpoint
    return found


def check(line):
    """Raise an AssertionError that says what a command names that is not there."""
    words = shlex.split(re.sub(r"\$\((?:[^()]|\([^()]*\))*\)", "SUBSTITUTED", line))
    for inner in re.findall(r"\$\(((?:[^()]|\([^()]*\))*)\)", line):
        for path in re.findall(r"\)/(\S+)", inner):
            assert (ROOT / path.removeprefix("share/sst_ros/")).exists(), path
    KINDS[words[0]](words[1:])


def _ros2(words):
    if words[0] in ("run", "launch") and words[1] in ("foxglove_bridge", "plotjuggler"):
        pass  # packages of others; paths of our files are checked by `check`
    elif words[0] in ("run", "launch"):
        assert words[1] == "sst_ros", words
        (run if words[0] == "run" else _launch)(words[2:])
    elif words[0] in ENDPOINTS:
        verbs, *uses = ENDPOINTS[words[0]]
        assert words[1] in verbs.split(), words
        given = [
            w for w in words[2:] if w[0] in "/{" or re.search("/(msg|srv|action)/", w)
        ]
        _endpoint(names(*uses), *given)
    elif words[0] == "param":
        assert words[1] in ("get", "set"), words
        (node,) = (node for node in NODES if f"/{node.name}" == words[2])
        spec = node.parameters.SPECS[words[3]]
        if words[1] == "set":
            assert words[3] in node.parameters.CHANGEABLE, f"{words[3]} is read-only"
            _value(spec, words[4])
    elif words[0] == "bag":
        for word in words:
            assert not word.startswith("/") or word in names(PUBLISHES, SUBSCRIBES), (
                word
            )
    else:
        assert words[0] in (
            "pkg",
            "security",
        ), f"ros2 {words[0]} is not known to this test"


def run(words):
    """Check an executable and its parameters, as plain options or as --ros-args has
    them.
    """
    command, *rest = words
    assert (ROOT / "executables" / command).is_file(), command
    known = NODE_COMMANDS[command][1].SPECS
    for name, assigned, text in (
        w.partition(":=") for w in ros_arguments(command, rest)
    ):
        if assigned and name in known:
            _value(known[name], text)


def _value(spec, text):
    """Check that ROS would read text as what the parameter takes."""
    kinds = {"flag": bool, "integer": int, "number": float, "texts": list, "text": str}
    kind = kinds.get(spec.kind)
    value = yaml.safe_load(text)
    if spec.shape:
        assert [type(number) for number in value] == [float] * spec.shape[0], text
        return
    assert kind is None or type(value) is kind, f"{text} is no {kind.__name__}"


def _launch(words):
    name, *given = words
    shared = ROOT / "sst_ros" / "launch_parts.py"
    text = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "launch" / name, shared)
    )
    for argument in (word.partition(":=")[0] for word in given if ":=" in word):
        assert f'"{argument}"' in text, f"{name} has no argument {argument}"


def _endpoint(offered, name, kind=None, content="{}"):
    """Check a name, its type, and that a message of it can be made of the YAML."""
    assert name in offered, name
    if kind is not None:
        assert kind == offered[name].type_name, kind
        fields = yaml.safe_load(content)
        if offered[name].use == EXECUTES:  # control_msgs is in no wheel
            fields, made = fields["trajectory"], JointTrajectory
            for point in fields.pop("points"):
                Duration(check_fields=True, **point.pop("time_from_start"))
                JointTrajectoryPoint(check_fields=True, **point)
        else:
            made = offered[name].kind
        getattr(made, "Request", made)(check_fields=True, **fields)


def _make(words):
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in (word for word in words if "=" not in word):
        assert re.search(rf"^{target}:", makefile, re.M), (
            f"make {target} is not in the Makefile"
        )


def _pip(words):
    for extra in re.findall(r"\[([\w,]+)\]", " ".join(words)):
        for name in extra.split(","):
            assert f'"{name}": ' in SETUP, f"there is no extra {name}"


KINDS = {
    "ros2": _ros2, "make": _make, "pip": _pip,
    # nothing of ours
    **dict.fromkeys(("cd", "export", "for", "done"), lambda words: None),
}  # fmt: skip
