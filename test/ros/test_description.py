# SPDX-License-Identifier: Apache-2.0
"""robot_description: latched, by default."""

import pytest
from std_msgs.msg import String

from sst_ros.description.urdf import urdf
from sst_ros.scene.scene import load

pytestmark = pytest.mark.ros


def test_the_description_is_latched(nodes, observer):
    nodes.run("simulator", scene="general", duration=0.0)
    observer.told("phase", lambda phase: phase in ("running", "fault"))
    heard = observer.listen(String, "/robot_description", latched=True)
    observer.until(lambda: heard, "robot_description")
    assert heard[-1].data == urdf(load("general"))
    assert '<link name="base_link">' in heard[-1].data


def test_it_can_be_left_out(nodes, observer):
    nodes.run("simulator", publish_description=False, duration=0.0)
    observer.told("phase", "running")
    assert "/robot_description" not in dict(observer.node.get_topic_names_and_types())
