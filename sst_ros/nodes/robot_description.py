# SPDX-License-Identifier: Apache-2.0
"""The scene as URDF on robot_description, for robot_state_publisher and RViz."""

from __future__ import annotations

from rclpy.node import Node
from std_msgs.msg import String

from sst_ros.description.urdf import urdf
from sst_ros.nodes import topics
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene.scene import Scene


def offer(node: Node, scene: Scene, given: SimulatorParameters) -> None:
    """Publish the URDF once, latched, where it is asked for."""
    if given.publish_description:
        topics.ROBOT_DESCRIPTION.publisher(node).publish(String(data=urdf(scene)))
