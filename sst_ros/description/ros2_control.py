# SPDX-License-Identifier: Apache-2.0
"""The actuators of a scene as hardware of ros2_control, which drives them over topics.

The plug-in is JointStateTopicSystem of the package joint_state_topic_hardware_interface. It sends
the effort of the joints of its tag only: passive joints, which have no command, must not be in it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

from sst_ros.description.urdf import urdf
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene

PLUGIN = "joint_state_topic_hardware_interface/JointStateTopicSystem"
STATES = ("position", "velocity", "effort")
EVERY_CYCLE = "-1"
"""Threshold of the change of a command below which the plug-in sends none: the simulator drops a
command that is not repeated within command_timeout."""


def urdf_with_ros2_control(
    scene: Scene,
    commands: str = "/sst_simulator/commands_stamped",
    states: str = "/joint_states",
) -> str:
    """Write a scene as URDF with the ros2_control tag of its actuators.

    Until the first joint states arrive, the hardware has the initial state of the scene: without it
    joint_trajectory_controller, activated before, holds nan, and no command starts the run.

    Args:
        scene: the scene.
        commands: topic on which the simulator takes commands by name.
        states: topic of its joint states.

    """
    root = ET.fromstring(urdf(scene), ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    tag = ET.SubElement(root, "ros2_control", name="sst_ros", type="system")
    hardware = ET.SubElement(tag, "hardware")
    ET.SubElement(hardware, "plugin").text = PLUGIN
    for name, value in (
        ("joint_commands_topic", commands),
        ("joint_states_topic", states),
        ("trigger_joint_command_threshold", EVERY_CYCLE),
    ):
        ET.SubElement(hardware, "param", name=name).text = value
    initial = scene.initial
    for name, *start in zip(JOINTS[:3], initial.gamma, initial.gamma_dot, strict=True):
        joint = ET.SubElement(tag, "joint", name=name)
        ET.SubElement(joint, "command_interface", name="effort")
        for state, start_value in zip(STATES, (*start, 0.0), strict=True):
            interface = ET.SubElement(joint, "state_interface", name=state)
            ET.SubElement(interface, "param", name="initial_value").text = repr(float(start_value))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
