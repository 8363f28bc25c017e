# SPDX-License-Identifier: Apache-2.0
"""Command lines of the nodes: what is accepted, and what is refused with the right spelling."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from sst_ros.errors import InputError
from sst_ros.nodes.arguments import COMMANDS, help_text, params_file_warnings, ros_arguments


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
        ("simulator", ["--publish_clock", "true", "--compiled", "false", "--use-sim-time"],
         {"publish_clock": True, "compiled": False, "use_sim_time": True}),
        ("simulator", ["--wait-for-subscribers", "joint_states,~/orientation"],
         {"wait_for_subscribers": ["joint_states", "~/orientation"]}),
        ("simulator", ["--tolerance", "1e-9"], {"tolerance": 1e-9}),
        ("inverse_dynamics", ["--damping", "1,2,3"], {"damping": [1.0, 2.0, 3.0]}),
        ("simulator", ["--scene", "swing", "--ros-args", "-p", "rate:=500", "-r", "__ns:=/left"],
         {"scene": "swing", "rate": 500, "__ns": "/left"}),
        ("simulator", [], {}),
    ],
)  # fmt: skip
def test_every_parameter_is_a_plain_option(command, words, expected):
    assert values(command, *words) == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--bogus"], "is no option: known are --scene, --rate"),
        (["--scen", "friction"], "did you mean --scene?"),
        (["scene", "friction"], "did you mean --scene VALUE?"),
        (["scene:=friction"], "did you mean --scene VALUE?"),
        (["--rate", "fast"], "--rate = 'fast': must be a whole number from 1 to 100000 [Hz]"),
        (["--duration", "nan"], "--duration = 'nan': must be a finite number"),
        (["--scene"], "needs a value"),
        (["--scene", "--rate", "3"], "needs a value"),
        (["-p", "rate:=500"], "goes behind --ros-args"),
        (["--ros-args", "-p", "nonexist:=1"], "nonexist"),
        (["--ros-args", "-p", "sceen:=friction"], "did you mean scene?"),
        (["--ros-args", "-p", "nonsense"], "must be NAME:=VALUE"),
        (["--ros-args", "--bogus"], "is no ROS argument"),
        (["--ros-args", "-r"], "needs a value"),
        (["--ros-args", "--params-file", "/nowhere.yaml"], "must be a parameter file"),
        (["--ros-args", "--params-file", __file__], "must be a parameter file"),
    ],
)  # fmt: skip
def test_what_is_no_argument_is_refused(words, said):
    more = ["-p", "y:=1"] if "--ros-args" in words else ["--ros-args", "-p", "y:=1"]
    with pytest.raises(InputError) as caught:
        ros_arguments("simulator", [*words, *more])
    assert said in str(caught.value)
    assert len(caught.value.problems) > 1  # every fault is listed


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scene: friction\n", "no ros__parameters"),
        ("- 1\n", "no mapping"),
        ("a: [\n", "must be a parameter file"),
        ("{}", "no ros__parameters"),
    ],
)
def test_a_file_that_is_no_parameter_file_is_refused(tmp_path, text, said):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        ros_arguments("simulator", ["--ros-args", "--params-file", str(path)])


@pytest.mark.parametrize(
    ("nodes", "words", "matches"),
    [
        ("sst_simulator", [], True),
        ("/sst_simulator", [], True),
        ("/**", ["-r", "__ns:=/a/b", "-r", "__node:=other"], True),
        ("/a/*", ["-r", "__ns:=/a"], True),
        ("/a/*", ["-r", "__ns:=/a/b"], False),
        ("sst_simulator", ["-r", "__ns:=/left"], False),
        ("sst_simulator", ["-r", "sst_simulator:__node:=other"], False),
        ("other", ["--remap", "__name:=other"], True),
        ("recorder", [], False),
    ],
)
def test_a_parameter_file_for_another_node_is_reported(tmp_path, nodes, words, matches):
    path = tmp_path / "file.yaml"
    path.write_text(yaml.safe_dump({nodes: {"ros__parameters": {"scene": "swing"}}}))
    ros = ros_arguments("simulator", ["--ros-args", "--params-file", str(path), *words])
    assert (not [*params_file_warnings("simulator", ros)]) == matches


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_every_parameter_with_default_and_bounds(command):
    text = " ".join(help_text(command).split())
    for name, spec in COMMANDS[command][1].SPECS.items():
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
