# SPDX-License-Identifier: Apache-2.0
"""The layouts of config/ fit the topics, types and frames, and the tree that TF draws is closed."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from sst_ros.description.urdf import urdf
from sst_ros.nodes import topics
from sst_ros.nodes.publications import StateMessages, stamp
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import load, names
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import BASE_FRAME

pytestmark = pytest.mark.ros
CONFIG = Path(__file__).parents[2] / "config"
PUBLISHED = {
    endpoint.at(f"/{node}"): endpoint.kind
    for node, endpoints in (
        ("sst_simulator", topics.SIMULATOR),
        ("sst_inverse_dynamics", topics.CONTROLLER),
    )
    for endpoint in endpoints.values()
    if endpoint.use == topics.PUBLISHES
}
"""Types of the topics in the root namespace."""
CLOSED = 1e-9
"""Largest distance between points of the star as legs 1, 2 and 3 place it [m]."""


def field_type(kind, path):
    """The type of a field of a message, given as x.y[0].z; the indices must be in range."""
    for part in path.split("."):
        name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", part).groups()
        kind = kind.get_fields_and_field_types()[name]
        if index is not None:
            assert kind.startswith("sequence<") and int(index) < len(JOINTS), (path, kind)
            kind = kind.removeprefix("sequence<").removesuffix(">")
        if "/" in kind:
            package, name = kind.split("/")
            kind = getattr(__import__(f"{package}.msg", fromlist=[name]), name)
    return kind


def values(tree, key):
    """All values of a key in nested mappings and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for name, value in items:
        if name == key:
            yield value
        if isinstance(value, (dict, list)):
            yield from values(value, key)


def test_foxglove_plots_and_shows_what_is_published():
    layout = json.loads((CONFIG / "foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    paths = [entry["value"] for paths in values(panels, "paths") for entry in paths]
    assert len(paths) == 12
    for path in paths:
        topic, _, field = path.partition(".")
        assert field_type(PUBLISHED[topic], field) == "double", path
    (model,) = (one for one in panels["3D!manipulator"]["layers"].values() if "topic" in one)
    assert model["topic"] == topics.SIMULATOR["robot_description"].at("/sst_simulator")
    assert PUBLISHED[model["jointStatesTopic"]] is JointState
    assert {*values(panels, "topicToRender"), *values(panels, "topicPath")} <= set(PUBLISHED)
    assert {*values(panels, "fixedFrame"), *values(panels, "frameId")} == {BASE_FRAME}
    shown = [name for key in ("first", "second") for name in values(layout["layout"], key)]
    assert sorted(name for name in shown if isinstance(name, str)) == sorted(panels)


def test_plotjuggler_plots_what_is_published():
    """Its series of a JointState are TOPIC/JOINT/position, velocity and effort."""
    root = ET.parse(CONFIG / "plotjuggler.xml").getroot()
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) == len(set(curves)) == 21
    for curve in curves:
        (topic,) = (topic for topic in PUBLISHED if curve.startswith(f"{topic}/"))
        field = curve.removeprefix(f"{topic}/").split("/")
        if PUBLISHED[topic] is JointState:
            assert field[0] in JOINTS and field[1] in ("position", "velocity", "effort"), curve
        else:
            assert field_type(PUBLISHED[topic], ".".join(field)) == "double", curve
    assert root.find("previouslyLoaded_Streamer").get("name") == "ROS2 Topic Subscriber"


def test_rviz_shows_our_topic_and_frame():
    text = (CONFIG / "sst_ros.rviz").read_text(encoding="utf-8")
    manager = yaml.safe_load(text)["Visualization Manager"]
    displays = {display["Class"].split("/")[1]: display for display in manager["Displays"]}
    assert set(displays) == {"Grid", "RobotModel", "TF"}
    description = displays["RobotModel"]["Description Topic"]
    assert description["Value"] == topics.SIMULATOR["robot_description"].name
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
            rpy = numbers(joint, "origin", "rpy")
            local[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
            local[:3, 3] = numbers(joint, "origin", "xyz")
            found = found @ local
        if joint.get("type") != "fixed":
            axis = np.array(numbers(joint, "axis", "xyz"))
            angle, about = angles[joint.get("name")], np.eye(4)
            about[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            found = found @ about
        return found

    return base, {link: pose(link) for link in parents}


@pytest.mark.parametrize("name", names())
def test_the_loops_of_the_drawn_tree_are_closed(name):
    scene = load(name)
    simulation = Simulation(scene)
    for _ in range(5):
        state = simulation.step((0.2, -0.1, 0.15), 2_000_000)
    numbers = state.quaternion, sum(state.joints, ()), state.torque
    published = deserialize_message(StateMessages().joint_states(stamp(1), numbers), JointState)
    angles = dict(zip(published.name, published.position, strict=True))
    base, found = transforms(urdf(scene), angles)
    assert base == BASE_FRAME
    ends = scene.star.radius * np.vstack([np.eye(3), -np.eye(3)])
    for leg in (2, 3):
        apart = found["star"] - found[f"star_from_{leg}"]
        assert np.linalg.norm(ends @ apart[:3, :3].T + apart[:3, 3], axis=1).max() < CLOSED
