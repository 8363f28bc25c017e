# SPDX-License-Identifier: Apache-2.0
"""robot_description, on request."""

import pytest
from std_msgs.msg import String

from sst_ros.description.urdf import urdf
from sst_ros.scene.scene import load

pytestmark = pytest.mark.ros


def test_the_description_is_latched(nodes, observer):
    nodes.run("simulator", scene="general", publish_description=True)
    observer.told("phase", lambda phase: phase in ("running", "fault"))
    heard = observer.listen(String, "/robot_description", latched=True)
    observer.until(lambda: heard, "robot_description")
    assert heard[-1].data == urdf(load("general"))


def test_nothing_is_published_that_was_not_asked_for(nodes, observer):
    nodes.run("simulator")
    observer.told("phase", "running")
    topics = dict(observer.node.get_topic_names_and_types())
    assert "/robot_description" not in topics
