# SPDX-License-Identifier: Apache-2.0
"""The tag of ros2_control, read as its parser and its plug-in read it."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from sst_ros.__main__ import main
from sst_ros.description.urdf import urdf, urdf_with_ros2_control
from sst_ros.scene.scene import load

ACTUATORS = ["gamma_1", "gamma_2", "gamma_3"]
CONTROLLERS = Path(__file__).parents[2] / "config" / "controllers.yaml"


def test_the_tag_has_the_actuators_and_the_topics_of_the_simulator():
    scene = load("general")
    (tag,) = ET.fromstring(urdf_with_ros2_control(scene, "/a/commands", "/a/states")).findall(
        "ros2_control"
    )
    assert tag.attrib == {"name": "sst_ros", "type": "system"}
    hardware = tag.find("hardware")
    assert (
        hardware.findtext("plugin") == "joint_state_topic_hardware_interface/JointStateTopicSystem"
    )
    assert {param.get("name"): param.text for param in hardware.findall("param")} == {
        "joint_commands_topic": "/a/commands",
        "joint_states_topic": "/a/states",
        "trigger_joint_command_threshold": "-1",
    }
    assert [joint.get("name") for joint in tag.findall("joint")] == ACTUATORS
    for joint in tag.findall("joint"):
        assert [one.get("name") for one in joint.findall("command_interface")] == ["effort"]
        states = [one.get("name") for one in joint.findall("state_interface")]
        assert states == ["position", "velocity", "effort"]


def test_the_states_before_the_first_message_are_the_initial_ones():
    """Without them a controller that is activated first holds nan, and no run starts."""
    scene = load("swing")
    tag = ET.fromstring(urdf_with_ros2_control(scene)).find("ros2_control")
    given = [
        [
            float(state.findtext("param[@name='initial_value']"))
            for state in joint.iter("state_interface")
        ]
        for joint in tag.findall("joint")
    ]
    initial = scene.initial
    assert given == [[*state, 0.0] for state in zip(initial.gamma, initial.gamma_dot, strict=True)]


@pytest.mark.parametrize("option", [[], ["--ros2-control"]])
def test_the_rest_is_the_urdf_of_the_scene(option, capsys):
    assert main(["describe", "--scene", "swing", *option]) == 0
    root = ET.fromstring(capsys.readouterr().out)
    for tag in root.findall("ros2_control"):
        root.remove(tag)
    plain = ET.fromstring(urdf(load("swing")))
    for tree in (root, plain):
        ET.indent(tree)
    assert ET.tostring(root).split() == ET.tostring(plain).split()


def test_every_controller_has_its_parameters_and_drives_the_actuators():
    document = yaml.safe_load(CONTROLLERS.read_text(encoding="utf-8"))
    given = {name.rpartition("/")[2]: node["ros__parameters"] for name, node in document.items()}
    manager = given.pop("controller_manager")
    assert set(given) == {name for name, value in manager.items() if isinstance(value, dict)}
    assert given["joint_state_broadcaster"]["use_local_topics"] is True
    for name in ("effort_controller", "trajectory_controller", "pid_controller"):
        joints = given[name].get("joints", given[name].get("dof_names"))
        assert joints == ACTUATORS
        assert set(given[name].get("gains", joints)) == set(joints)
