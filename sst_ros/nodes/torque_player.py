# SPDX-License-Identifier: Apache-2.0
"""The torque player: answers every joint state with the torque of its instant."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from sst_ros import scene
from sst_ros.control import torque_profiles
from sst_ros.errors import InputError, Problem, SstError
from sst_ros.mechanism.vec3 import ZERO
from sst_ros.nodes import parameters, process, topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.torque_commands import TorqueCommands
from sst_ros.runtime.settings import PlayerParameters
from sst_ros.simulation import NANOSECONDS


class TorquePlayer:
    """Worker of the process `torque_player`."""

    def __init__(self) -> None:
        self.node = Node("sst_torque_player")
        self.done = threading.Event()
        self._parameters = parameters.declare(self.node, PlayerParameters)
        self._profile, self._duration = self._load()
        self._commands = TorqueCommands(self.node, self._parameters)
        self._start_ns: int | None = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        phase = f"{self._parameters.simulator}/phase"
        self.node.create_subscription(String, phase, self._hear, latched)
        played = topics.PLAYED
        self.node.create_subscription(played.kind, played.name, self._answer, played.depth)
        self.node.create_timer(0.5, self._commands.watch, clock=STEADY)

    def close(self) -> None:
        """Leave the actuators without torque if the profile was cut short."""
        if self._start_ns is not None and not self.done.is_set():
            self._commands.send(ZERO)

    def _load(self) -> tuple[torque_profiles.Profile, float]:
        if self._parameters.csv != "-":
            return torque_profiles.table(Path(self._parameters.csv))
        played = scene.load(self._parameters.scene)
        if played.torque is None or played.duration is None:
            allowed = "must have torque and duration to be played, or csv must name a file"
            raise InputError("torque_player", [Problem("scene", played.name, allowed)])
        return torque_profiles.sine(played.torque), played.duration

    def _hear(self, phase: String) -> None:
        if self._start_ns is not None and phase.data.startswith("fault"):
            raise SstError(f"the simulator stopped: {phase.data}")

    def _answer(self, state: JointState) -> None:
        """Play the torque of the sample's instant; before the run, that of its start."""
        self._commands.received()
        # Once begun, the simulator may end before its last sample has arrived.
        if self._start_ns is None and not self._commands.subscribed():
            return
        stamp_ns = self._commands.answering(state)
        if stamp_ns == 0:
            if self._start_ns is None:
                self._commands.send(self._profile(0.0))
            return
        if self._start_ns is None:
            self._start_ns = stamp_ns
        elapsed = (stamp_ns - self._start_ns) / NANOSECONDS
        if elapsed < self._duration:
            self._commands.send(self._profile(elapsed))
        else:
            self._commands.send(ZERO)
            self.node.get_logger().info(f"the profile of {self._duration:g} s is played")
            self.done.set()


def main(args: list[str] | None = None) -> int:
    """Run the node; `args` begin with the name of the program."""
    return process.run("torque_player", TorquePlayer, args)


if __name__ == "__main__":
    sys.exit(main())
