# SPDX-License-Identifier: Apache-2.0
"""Torque commands of a node that answers joint states: plain, or by name and stamp."""

from __future__ import annotations

import time
from array import array
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from sst_ros.errors import SstError
from sst_ros.mechanism.generic_math import ZERO
from sst_ros.nodes import topics
from sst_ros.runtime.settings import AnsweringParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.state import Vector3, is_idle, nanoseconds


class TorqueCommands:
    """Publisher of the commands, and the time-out of the joint states that they answer.

    Attributes:
        publisher: of the commands.

    """

    def __init__(self, node: Node, given: AnsweringParameters) -> None:
        self._given = given
        topic = topics.PLAYER["commands_stamped" if given.stamped else "commands"]
        if given.stamped:
            self._message: Any = JointState(name=list(ACTUATORS), effort=array("d", ZERO))
            self._torques = self._message.effort
        else:
            self._message = Float64MultiArray(data=array("d", ZERO))
            self._torques = self._message.data
        self.publisher = topic.publisher(node, simulator=given.simulator)
        self.restart_timeout()

    def has_subscribers(self) -> bool:
        """Whether they have as many subscribers as the parameters ask for."""
        return self.publisher.get_subscription_count() >= self._given.min_subscribers

    def answer_to(self, state: JointState) -> int:
        """Give the next commands the stamp of a state; return it [ns], 0 where it is no sample."""
        if self._given.stamped:
            self._message.header.stamp = state.header.stamp
        stamp_ns = nanoseconds(state.header.stamp)
        return 0 if is_idle(stamp_ns, state.header.frame_id) else stamp_ns

    def send(self, torque: Vector3) -> None:
        """Publish torques [N m]."""
        self._torques[0], self._torques[1], self._torques[2] = torque
        self.publisher.publish(self._message)

    def restart_timeout(self) -> None:
        """Count the time-out of joint_states from now on."""
        self._received = time.monotonic()

    def watch(self) -> None:
        """Raise an SstError if no joint_states came for longer than the parameter `timeout`."""
        silent = time.monotonic() - self._received
        if silent > self._given.timeout:
            raise SstError(f"no joint_states for {silent:.1f} s: is the simulator running?")
