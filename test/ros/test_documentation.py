# SPDX-License-Identifier: Apache-2.0
"""config/ against the declarations, and these against running nodes: policies, layouts,
keys.
"""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from sst_ros.nodes import topics
from sst_ros.runtime import diagnostics
from sst_ros.scene.loads import JOINTS
from sst_ros.state import BASE_FRAME
from tools.reference_pages import NODES, SIMULATION_INTERFACES, policy

pytestmark = pytest.mark.ros
CONFIG = Path(__file__).parents[2] / "config"
RIGHTS = ("publish", "subscribe", "reply", "request")
WITHOUT_REASON = {
    *("/clock", "/sst_simulator/external_moment", "/sst_simulator/commands_stamped"),
    *("/sst_simulator/true_joint_states", "/sst_simulator/imu"),
    "/sst_simulator/reaction",
}
"""Topics that exist under conditions only: a parameter, or the scene."""
PUBLISHED = {
    endpoint.at(f"/{node.name}"): endpoint.kind
    for node in NODES
    for endpoint in node.endpoints
    if endpoint.use == topics.PUBLISHES and "{" not in endpoint.name
}
"""Types of the topics in the root namespace."""


@pytest.mark.parametrize("node", NODES, ids=lambda node: node.command)
def test_policies_are_those_of_the_declarations_in_sros2s_form(node):
    """As in sros2's policy.xsd, version 0.2.0."""
    data = (CONFIG / "sros2" / f"{node.command}.policy.xml").read_bytes()
    assert data == policy(node).encode()
    root = ET.fromstring(data)
    assert root.attrib == {"version": "0.2.0"}
    path, groups = [root], list(root)
    while groups[0].tag in ("enclaves", "enclave", "profiles", "profile"):
        (only,) = groups
        path, groups = [*path, only], list(only)
    assert [one.tag for one in path] == [
        "policy",
        "enclaves",
        "enclave",
        "profiles",
        "profile",
    ]
    assert path[2].attrib["path"].startswith("/")
    assert path[4].attrib == {"ns": "/", "node": node.name}
    rights = {"topics": {"publish", "subscribe"}, "services": {"reply", "request"}}
    rights["actions"] = {"execute"}
    for group in groups:
        assert set(group.attrib) <= rights[group.tag] and set(
            group.attrib.values()
        ) == {"ALLOW"}
        assert len(group) and {entry.tag for entry in group} == {group.tag[:-1]}
        assert all(entry.text.startswith("/") and not entry.attrib for entry in group)


def allowed(node):
    return {
        right: {
            entry.text
            for group in ET.fromstring(policy(node).encode()).iter()
            if group.get(right) == "ALLOW"
            for entry in group
        }
        for right in RIGHTS
    }


def used(graph, name):
    listed = (
        graph.get_publisher_names_and_types_by_node,
        graph.get_subscriber_names_and_types_by_node,
        graph.get_service_names_and_types_by_node,
        graph.get_client_names_and_types_by_node,
    )
    pairs = zip(RIGHTS, listed, strict=True)
    return {right: {topic for topic, _ in found(name, "/")} for right, found in pairs}


@pytest.mark.slow
def test_the_policies_allow_what_running_nodes_use_and_no_more(
    nodes, observer, tmp_path
):
    nodes.run("simulator", wait_for_command=True)
    observer.phase("waiting")
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    assert nodes.line(recorder).startswith("ready")
    nodes.run("torque_player", min_subscribers=100, stamped=False)
    nodes.run("inverse_dynamics", min_subscribers=100)
    nodes.run("viewer")
    for node in NODES:
        expected = allowed(node)
        needed = {
            right: {
                name
                for name in names - WITHOUT_REASON
                if (node.command, name) != ("viewer", "/sst_simulator/commands")
                if name.rpartition("/")[2] not in SIMULATION_INTERFACES
            }
            for right, names in expected.items()
        }

        def all_there(name=node.name, needed=needed):
            if name not in observer.node.get_node_names():
                return False
            return all(
                needed[right] <= real
                for right, real in used(observer.node, name).items()
            )

        observer.until(all_there, f"all of {node.name}")
        for right, names in used(observer.node, node.name).items():
            assert names <= expected[right], (node.name, right)


@pytest.mark.breadth
def test_diagnostics_are_the_docs_and_description_is_optional(nodes, observer):
    # The scene has limits, and so distances to them.
    nodes.run("simulator", scene="example2_heavy", publish_description=False)
    observer.told("phase", "running")
    said = observer.told("error_estimate", lambda value: True)
    # Without a torque that is held there is no error of the hold.
    known = [key for key in diagnostics.KEYS if not key.startswith("hold_error")]
    assert list(said)[:-2] == known
    assert "/robot_description" not in dict(observer.node.get_topic_names_and_types())


def field_type(kind, path):
    """The type of a field of a message, given as x.y[0].z.

    The indices must be in range.
    """
    for part in path.split("."):
        name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", part).groups()
        kind = kind.get_fields_and_field_types()[name]
        if index is not None:
            assert kind.startswith("sequence<") and int(index) < len(JOINTS), (
                path,
                kind,
            )
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
    assert len(paths) == 21
    for path in paths:
        topic, _, field = path.partition(".")
        assert field_type(PUBLISHED[topic], field) == "double", path
    (model,) = (
        one for one in panels["3D!manipulator"]["layers"].values() if "topic" in one
    )
    assert model["topic"] == topics.SIMULATOR["robot_description"].at("/sst_simulator")
    assert PUBLISHED[model["jointStatesTopic"]] is JointState
    assert {*values(panels, "topicToRender"), *values(panels, "topicPath")} <= set(
        PUBLISHED
    )
    assert {*values(panels, "fixedFrame"), *values(panels, "frameId")} == {BASE_FRAME}
    shown = [
        name for key in ("first", "second") for name in values(layout["layout"], key)
    ]
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
            assert field[0] in JOINTS and field[1] in (
                "position",
                "velocity",
                "effort",
            ), curve
        else:
            assert field_type(PUBLISHED[topic], ".".join(field)) == "double", curve
    assert root.find("previouslyLoaded_Streamer").get("name") == "ROS2 Topic Subscriber"


def test_rviz_shows_our_topic_and_frame():
    text = (CONFIG / "sst_ros.rviz").read_text(encoding="utf-8")
    manager = yaml.safe_load(text)["Visualization Manager"]
    displays = {
        display["Class"].split("/")[1]: display for display in manager["Displays"]
    }
    assert set(displays) == {"Grid", "RobotModel", "TF", "Wrench"}
    description = displays["RobotModel"]["Description Topic"]
    assert description["Value"] == topics.SIMULATOR["robot_description"].name
    assert description["Durability Policy"] == "Transient Local"
    reaction = displays["Wrench"]["Topic"]
    assert f"/{reaction['Value']}" == topics.SIMULATOR["reaction"].at("/sst_simulator")
    assert PUBLISHED[f"/{reaction['Value']}"] is WrenchStamped
    assert manager["Global Options"]["Fixed Frame"] == BASE_FRAME
    assert displays["Grid"]["Reference Frame"] == BASE_FRAME
