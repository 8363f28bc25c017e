# SPDX-License-Identifier: Apache-2.0
"""How a node that answers joint states commands torques: plain, or by name and stamp."""

from __future__ import annotations

import time
from array import array
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from sst_ros.errors import SstError
from sst_ros.mechanism.vec3 import ZERO
from sst_ros.nodes.messages import nanoseconds
from sst_ros.runtime.controller_node_settings import CompanionParameters
from sst_ros.runtime.settings import PlayerParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.simulation import Triple


class TorqueCommands:
    """The topic that the parameters name, and the watch over what is answered on it.

    Attributes:
        publisher: of the commands.

    """

    def __init__(self, node: Node, given: PlayerParameters | CompanionParameters) -> None:
        self._given = given
        if given.stamped:
            topic = f"{given.simulator}/commands_stamped"
            self._message: Any = JointState(name=ACTUATORS, effort=array("d", ZERO))
            self._torques = self._message.effort
        else:
            topic = f"{given.simulator}/commands"
            self._message = Float64MultiArray(data=array("d", ZERO))
            self._torques = self._message.data
        self.publisher = node.create_publisher(type(self._message), topic, 10)
        self.heard()

    def are_read(self) -> bool:
        """Tell whether as many read them as the parameters say to wait for."""
        return self.publisher.get_subscription_count() >= self._given.wait_for_subscribers

    def answering(self, state: JointState) -> int:
        """Put the stamp of a sample on what is sent from now on; return it [ns]."""
        if self._given.stamped:
            self._message.header.stamp = state.header.stamp
        return nanoseconds(state.header.stamp)

    def send(self, torque: Triple) -> None:
        """Publish torques [N m]."""
        self._torques[0], self._torques[1], self._torques[2] = torque
        self.publisher.publish(self._message)

    def heard(self) -> None:
        """Begin to wait for the next joint_states."""
        self._heard = time.monotonic()

    def watch(self) -> None:
        """Raise an SstError if joint_states have been silent for longer than allowed."""
        silent = time.monotonic() - self._heard
        if silent > self._given.timeout:
            raise SstError(f"no joint_states for {silent:.1f} s: is the simulator running?")
