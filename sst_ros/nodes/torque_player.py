# SPDX-License-Identifier: Apache-2.0
"""The torque player: answers every joint state with the torque of its instant."""

from __future__ import annotations

import sys
import threading
import time
from array import array
from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from sst_ros import scene
from sst_ros.control import torque
from sst_ros.errors import InputError, Problem, SstError
from sst_ros.nodes import parameters, process
from sst_ros.schema import Section, integer, number, text
from sst_ros.simulation import NANOSECONDS


@dataclass(frozen=True)
class PlayerParameters(Section):
    """Parameters of sst_torque_player."""

    scene: str = text("scene whose torque is played, by name or by path", default="example2")
    csv: str = text("file with time, tau_1, tau_2, tau_3 to play instead; - for none", default="-")
    simulator: str = text("name of the simulator's node", default="sst_simulator")
    wait_for_subscribers: int = integer(
        "readers of the commands to wait for", "1", default=1, least=1, most=100
    )
    timeout: float = number(
        "longest silence of joint_states", "s", default=10.0, least=0.1, most=1e6
    )


class TorquePlayer:
    """Worker of the process `torque_player`."""

    def __init__(self) -> None:
        self.node = Node("sst_torque_player")
        self.done = threading.Event()
        self._parameters = parameters.declare(self.node, PlayerParameters)
        self._profile, self._duration = self._load()
        topic = f"{self._parameters.simulator}/commands"
        self._commands = self.node.create_publisher(Float64MultiArray, topic, 10)
        self._message = Float64MultiArray(data=array("d", [0.0] * 3))
        self._start_ns: int | None = None
        self._heard = time.monotonic()
        self.node.create_subscription(JointState, "joint_states", self._answer, 10)
        self.node.create_timer(0.5, self._watch)

    def close(self) -> None:
        """Leave the actuators without torque if the profile was cut short."""
        if self._start_ns is not None and not self.done.is_set():
            self._send((0.0, 0.0, 0.0))

    def _load(self) -> tuple[torque.Profile, float]:
        if self._parameters.csv != "-":
            return torque.table(Path(self._parameters.csv))
        played = scene.load(self._parameters.scene)
        if played.torque is None or played.duration is None:
            allowed = "must have torque and duration, or csv must name a file"
            raise InputError("torque_player", [Problem("scene", played.name, allowed)])
        return torque.sine(played.torque), played.duration

    def _answer(self, state: JointState) -> None:
        """Play the torque of the state's instant; stamp zero means that no run has begun."""
        self._heard = time.monotonic()
        if self._commands.get_subscription_count() < self._parameters.wait_for_subscribers:
            return
        stamp_ns = state.header.stamp.sec * NANOSECONDS + state.header.stamp.nanosec
        if stamp_ns == 0:
            self._send(self._profile(0.0))
            return
        if self._start_ns is None:
            self._start_ns = stamp_ns
        elapsed = (stamp_ns - self._start_ns) / NANOSECONDS
        if elapsed < self._duration:
            self._send(self._profile(elapsed))
        else:
            self._send((0.0, 0.0, 0.0))
            self.node.get_logger().info(f"the profile of {self._duration:g} s is played")
            self.done.set()

    def _send(self, torques: torque.Torque) -> None:
        data = self._message.data
        data[0], data[1], data[2] = torques
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
