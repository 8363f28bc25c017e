# SPDX-License-Identifier: Apache-2.0
"""Command lines of the nodes: what is accepted, and what is refused with the right
spelling.
"""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sst_ros.errors import InputError
from sst_ros.runtime.arguments import make_parser, ros_arguments, unused_files
from sst_ros.runtime.settings import NODE_COMMANDS


def values(command, *words):
    """Parameters as rcl reads them from the ROS arguments."""
    ros = ros_arguments(command, words)
    assert not ros or ros[0] == "--ros-args"
    pairs = (word.partition(":=") for word in ros if ":=" in word)
    return {name: yaml.safe_load(value) for name, _, value in pairs}


@pytest.mark.parametrize(
    ("command", "words", "expected"),
    [
        ("simulator", ["--scene", "friction"], {"scene": "friction"}),
        ("simulator", ["--scene=3"], {"scene": "3"}),
        ("simulator", ["--publish-rate", " 100", "--duration=2 "],
         {"publish_rate": 100, "duration": 2.0}),
        ("simulator", ["--wait-for-command"], {"wait_for_command": True}),
        ("simulator", ["--publish_clock", "true", "--use-sim-time"],
         {"publish_clock": True, "use_sim_time": True}),
        ("simulator", ["--wait-for-subscribers", "joint_states,~/orientation"],
         {"wait_for_subscribers": ["joint_states", "~/orientation"]}),
        ("recorder", ["--topics", '["/joint_states"]'], {"topics": ["/joint_states"]}),
        ("recorder", ["--topics", "['/a', \"/b\", /c]"],
         {"topics": ["/a", "/b", "/c"]}),
        ("simulator", ["--tolerance", "1e-9"], {"tolerance": 1e-9}),
        ("inverse_dynamics", ["--damping", "1,2,3"], {"damping": [1.0, 2.0, 3.0]}),
        ("simulator",
         ["--scene", "swing", "--ros-args", "-p", "rate:=500", "-r", "__ns:=/left"],
         {"scene": "swing", "rate": 500, "__ns": "/left"}),
        ("simulator", [], {}),
    ],
)  # fmt: skip
def test_every_parameter_is_a_plain_option(command, words, expected):
    assert values(command, *words) == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--bogus"], "behind --ros-args; known are --scene, --rate"),
        (["--ros-args", "--log-level", "loud"],
         "--log-level = 'loud': must be one of debug, info"),
        (["--ros-args", "--log-level", "sst_simulator:=loud"],
         "must be one of debug, info, warn"),
        (["--scen", "friction"], "argument = '--scen': is no parameter of the node"),
        (["--scen", "friction"], "did you mean '--scene'?"),
        (["scene", "friction"], "did you mean '--scene'?"),
        (["scene:=friction"], "did you mean '--scene'?"),
        (["--rate", "fast"],
         "--rate = 'fast': must be a whole number from 1 to 100000 [Hz]"),
        (["--duration", "nan"], "--duration = 'nan': must be a finite number"),
        (["--scene"], "needs a value"),
        (["--scene", "--rate", "3"], "needs a value"),
        (["-p", "rate:=500"], "unless behind --ros-args"),
        (["--ros-args", "-p", "nonexist:=1"], "nonexist"),
        (["--ros-args", "-p", "sceen:=friction"], "did you mean 'scene'?"),
    ],
)  # fmt: skip
def test_what_is_no_argument_is_refused(words, said):
    more = ["-p", "y:=1"] if "--ros-args" in words else ["--ros-args", "-p", "y:=1"]
    with pytest.raises(InputError) as caught:
        ros_arguments("simulator", [*words, *more])
    assert said in str(caught.value)
    assert len(caught.value.problems) > 1  # every fault is listed


@pytest.mark.parametrize("level", ["debug", "WARN", "sst_simulator:=fatal"])
def test_log_levels_of_rcl_are_left_to_it(level):
    words = ["--ros-args", "--log-level", level]
    assert ros_arguments("simulator", words) == words


@pytest.mark.parametrize(
    ("nodes", "node", "matches"),
    [
        ("sst_simulator", "/sst_simulator", True),
        ("/sst_simulator", "/sst_simulator", True),
        ("/**", "/a/b/other", True),
        ("/a/*", "/a/sst_simulator", True),
        ("/a/*", "/a/b/sst_simulator", False),
        ("sst_simulator", "/left/sst_simulator", False),
        ("other", "/sst_simulator", False),
    ],
)
def test_a_parameter_file_for_another_node_is_reported(tmp_path, nodes, node, matches):
    path = tmp_path / "file.yaml"
    path.write_text(yaml.safe_dump({nodes: {"ros__parameters": {"scene": "swing"}}}))
    ros = ros_arguments("simulator", ["--ros-args", "--params-file", str(path)])
    assert (not [*unused_files(ros, node)]) == matches


@pytest.mark.parametrize("command", NODE_COMMANDS)
def test_help_has_every_parameter_with_default_and_bounds(command):
    text = " ".join(make_parser(command).format_help().split())
    for name, spec in NODE_COMMANDS[command][1].SPECS.items():
        assert f"--{name.replace('_', '-')} " in text
        assert spec.describe() in text


@given(st.text(st.characters(categories=["L", "N", "P", "S"]), min_size=1))
def test_any_text_reaches_the_parameter_as_it_is(text):
    assert values("simulator", f"--scene={text}") == {"scene": text}


@given(st.lists(st.text(max_size=12), max_size=4))
def test_any_words_are_accepted_or_refused_in_words(words):
    try:
        ros_arguments("simulator", words)
    except InputError as error:
        assert error.problems
