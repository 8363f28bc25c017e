# SPDX-License-Identifier: Apache-2.0
"""The RViz layout fits the topics and the frames of the simulator, and the tree that TF draws."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml

from sst_ros.description.headers import BASE_FRAME
from sst_ros.description.urdf import urdf
from sst_ros.nodes import topics
from sst_ros.scene.scene import load, names
from sst_ros.simulation.simulation import Simulation

pytestmark = pytest.mark.ros
LAYOUT = Path(__file__).parents[2] / "config" / "sst_ros.rviz"
CLOSED = 1e-9
"""Largest distance between points of the star as legs 1, 2 and 3 place it [m]."""


def test_the_layout_names_our_topic_and_frame():
    manager = yaml.safe_load(LAYOUT.read_text(encoding="utf-8"))["Visualization Manager"]
    displays = {display["Class"].split("/")[1]: display for display in manager["Displays"]}
    assert set(displays) == {"Grid", "RobotModel", "TF"}
    description = displays["RobotModel"]["Description Topic"]
    assert description["Value"] == topics.ROBOT_DESCRIPTION.name
    assert description["Durability Policy"] == "Transient Local"
    assert manager["Global Options"]["Fixed Frame"] == BASE_FRAME
    assert displays["Grid"]["Reference Frame"] == BASE_FRAME


def transforms(document, angles):
    """Poses in the root, as robot_state_publisher computes them from the URDF and joint_states."""
    root = ET.fromstring(document)
    joints = root.findall("joint")
    parents = {joint.find("child").get("link"): joint for joint in joints}
    (base,) = {link.get("name") for link in root.findall("link")} - set(parents)

    def numbers(joint, tag, name):
        return [float(x) for x in joint.find(tag).get(name).split()]

    def pose(link):
        if link == base:
            return np.eye(4)
        joint = parents[link]
        found = pose(joint.find("parent").get("link"))
        if joint.find("origin") is not None:
            local = np.eye(4)
            roll, pitch, yaw = numbers(joint, "origin", "rpy")
            local[:3, :3] = turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)
            local[:3, 3] = numbers(joint, "origin", "xyz")
            found = found @ local
        if joint.get("type") != "fixed":
            x, y, z = numbers(joint, "axis", "xyz")
            across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            angle, about = angles[joint.get("name")], np.eye(4)
            about[:3, :3] += np.sin(angle) * across + (1.0 - np.cos(angle)) * across @ across
            found = found @ about
        return found

    return base, {link: pose(link) for link in parents}


def turn(axis, angle):
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


@pytest.mark.parametrize("name", names())
def test_the_loops_of_the_drawn_tree_are_closed(name):
    scene = load(name)
    simulation = Simulation(scene)
    for _ in range(5):
        joints = simulation.step((0.2, -0.1, 0.15), 2_000_000).joints
    angles = {
        f"{kind}_{leg + 1}": getattr(joints, kind)[leg]
        for kind in ("gamma", "mu", "beta")
        for leg in range(3)
    }
    base, found = transforms(urdf(scene), angles)
    assert base == BASE_FRAME
    ends = scene.star.radius * np.vstack([np.eye(3), -np.eye(3)])
    for leg in (2, 3):
        apart = found["star"] - found[f"star_from_{leg}"]
        assert np.linalg.norm(ends @ apart[:3, :3].T + apart[:3, 3], axis=1).max() < CLOSED
