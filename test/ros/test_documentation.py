# SPDX-License-Identifier: Apache-2.0
"""SROS2 policies against the declarations, and these against running nodes."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from sst_ros.runtime import diagnostics
from tools.reference_pages import NODES, SIMULATION_INTERFACES, policy

pytestmark = pytest.mark.ros
ROOT = Path(__file__).parents[2]
IDS = [node.command for node in NODES]
WITHOUT_REASON = {
    "/clock",
    "/sst_simulator/external_moment",
    "/sst_simulator/commands_stamped",
}
"""Topics that exist under conditions only: a parameter, or the scene."""


@pytest.mark.parametrize("node", NODES, ids=IDS)
def test_the_policies_are_those_of_the_declarations(node):
    path = ROOT / "config" / "sros2" / f"{node.command}.policy.xml"
    assert path.read_text(encoding="utf-8") == policy(node)


@pytest.mark.parametrize("node", NODES, ids=IDS)
def test_the_policies_have_the_form_of_sros2(node):
    """As in sros2's policy.xsd, version 0.2.0."""
    root = ElementTree.fromstring(policy(node).encode())
    assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
    (enclaves,) = root
    (enclave,) = enclaves
    assert (enclaves.tag, enclave.tag) == ("enclaves", "enclave")
    assert enclave.attrib["path"].startswith("/")
    (profiles,) = enclave
    (profile,) = profiles
    assert (profiles.tag, profile.tag) == ("profiles", "profile")
    assert profile.attrib == {"ns": "/", "node": node.name}
    rights = {"topics": {"publish", "subscribe"}, "services": {"reply", "request"}}
    rights["actions"] = {"execute"}
    for group in profile:
        assert set(group.attrib) <= rights[group.tag]
        assert set(group.attrib.values()) == {"ALLOW"}
        assert len(group) and {entry.tag for entry in group} == {group.tag[:-1]}
        assert all(entry.text.startswith("/") and not entry.attrib for entry in group)


def allowed(node):
    result = {}
    for group in ElementTree.fromstring(policy(node).encode()).iter():
        for right in ("publish", "subscribe", "reply", "request"):
            if group.get(right) == "ALLOW":
                result.setdefault(right, set()).update(entry.text for entry in group)
    return result


def used(observer, name):
    graph, at = observer.node, (name, "/")
    return {
        "publish": {topic for topic, _ in graph.get_publisher_names_and_types_by_node(*at)},
        "subscribe": {topic for topic, _ in graph.get_subscriber_names_and_types_by_node(*at)},
        "reply": {topic for topic, _ in graph.get_service_names_and_types_by_node(*at)},
        "request": {topic for topic, _ in graph.get_client_names_and_types_by_node(*at)},
    }


@pytest.mark.slow
def test_the_policies_allow_what_running_nodes_use_and_no_more(nodes, observer, tmp_path):
    nodes.run("simulator", wait_for_command=True)
    observer.told("phase", "waiting")
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    assert nodes.line(recorder).startswith("ready")
    nodes.run("torque_player", min_subscribers=100)
    nodes.run("inverse_dynamics", min_subscribers=100)
    nodes.run("viewer")
    for node in NODES:
        expected = allowed(node)

        def missing(node=node, expected=expected):
            if node.name not in observer.node.get_node_names():
                return [node.name]
            real = used(observer, node.name)
            return [
                (right, name)
                for right in ("publish", "subscribe", "reply", "request")
                for name in expected.get(right, set()) - real[right] - WITHOUT_REASON
                if (node.command, name) != ("viewer", "/sst_simulator/commands")
                if name.rpartition("/")[2] not in SIMULATION_INTERFACES
            ]

        observer.until(lambda missing=missing: not missing(), f"all of {node.name}")
        real = used(observer, node.name)
        for right, names in real.items():
            assert names <= expected.get(right, set()), (node.name, right)


def test_the_diagnostics_are_those_of_the_docs_and_the_description_can_be_left_out(nodes, observer):
    # The scene has limits, and so distances to them.
    nodes.run("simulator", scene="example2_heavy", publish_description=False)
    said = observer.told("phase", "running")
    said = observer.told("error_estimate", lambda value: True)
    # Without a torque that is held there is no error of the hold.
    known = [key for key in diagnostics.KEYS if not key.startswith("hold_error")]
    assert list(said)[:-2] == known
    assert "/robot_description" not in dict(observer.node.get_topic_names_and_types())
