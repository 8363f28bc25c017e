# SPDX-License-Identifier: Apache-2.0
"""The torque player: answers every joint state with the torque of its instant."""

from __future__ import annotations

import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from sst_ros import scene
from sst_ros.control import torque
from sst_ros.errors import InputError, Problem, SstError
from sst_ros.nodes import parameters, process
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.commands import ACTUATORS, ZERO
from sst_ros.nodes.messages import nanoseconds
from sst_ros.nodes.settings import PlayerParameters
from sst_ros.simulation import NANOSECONDS


class TorquePlayer:
    """Worker of the process `torque_player`."""

    def __init__(self) -> None:
        self.node = Node("sst_torque_player")
        self.done = threading.Event()
        self._parameters = parameters.declare(self.node, PlayerParameters)
        self._profile, self._duration = self._load()
        simulator, stamped = self._parameters.simulator, self._parameters.stamped
        if stamped:
            topic = f"{simulator}/commands_stamped"
            self._message: Any = JointState(name=ACTUATORS, effort=array("d", ZERO))
            self._torques = self._message.effort
        else:
            topic = f"{simulator}/commands"
            self._message = Float64MultiArray(data=array("d", ZERO))
            self._torques = self._message.data
        self._commands = self.node.create_publisher(type(self._message), topic, 10)
        self._start_ns: int | None = None
        self._heard = time.monotonic()
        self._phase = ""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, f"{simulator}/phase", self._hear, latched)
        self.node.create_subscription(JointState, "joint_states", self._answer, 10)
        self.node.create_timer(0.5, self._watch, clock=STEADY)

    def close(self) -> None:
        """Leave the actuators without torque if the profile was cut short."""
        if self._start_ns is not None and not self.done.is_set():
            self._send(ZERO)

    def _load(self) -> tuple[torque.Profile, float]:
        if self._parameters.csv != "-":
            return torque.table(Path(self._parameters.csv))
        played = scene.load(self._parameters.scene)
        if played.torque is None or played.duration is None:
            allowed = "must have torque and duration, or csv must name a file"
            raise InputError("torque_player", [Problem("scene", played.name, allowed)])
        return torque.sine(played.torque), played.duration

    def _hear(self, phase: String) -> None:
        self._phase = phase.data
        if self._start_ns is not None and phase.data.startswith("fault"):
            raise SstError(f"the simulator stopped: {phase.data}")

    def _answer(self, state: JointState) -> None:
        """Play the torque of the state's instant; stamp zero means that it is of no run."""
        self._heard = time.monotonic()
        if self._commands.get_subscription_count() < self._parameters.wait_for_subscribers:
            return
        stamp_ns = nanoseconds(state.header.stamp)
        if self._parameters.stamped:
            self._message.header.stamp = state.header.stamp
        if stamp_ns == 0:
            if self._start_ns is None:
                self._send(self._profile(0.0))
            return
        if self._start_ns is None:
            self._start_ns = stamp_ns
        elapsed = (stamp_ns - self._start_ns) / NANOSECONDS
        if elapsed < self._duration:
            self._send(self._profile(elapsed))
        else:
            self._send(ZERO)
            self.node.get_logger().info(f"the profile of {self._duration:g} s is played")
            self.done.set()

    def _send(self, torques: torque.Torque) -> None:
        self._torques[0], self._torques[1], self._torques[2] = torques
        self._commands.publish(self._message)

    def _watch(self) -> None:
        silent = time.monotonic() - self._heard
        if silent > self._parameters.timeout:
            raise SstError(f"no joint_states for {silent:.1f} s: is the simulator running?")


def main(args: list[str] | None = None) -> int:
    """Entry point of `torque_player`."""
    return process.run("torque_player", TorquePlayer, args)


if __name__ == "__main__":
    sys.exit(main())
