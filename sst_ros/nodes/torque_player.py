# SPDX-License-Identifier: Apache-2.0
"""The torque player: answers every joint state with the torque of a hold.

The hold begins at that state and ends at the next sample. With the torque of its middle
the error of the motion is of second order in the period, with that of its start of
first order only.
"""

from __future__ import annotations

from sensor_msgs.msg import JointState

from sst_ros.errors import refusal
from sst_ros.nodes import topics
from sst_ros.nodes.answering import AnsweringWorker
from sst_ros.runtime.settings import PlayerParameters
from sst_ros.scene import scene
from sst_ros.scene.torque_profile import TorqueProfile, TorqueTable
from sst_ros.state import NANOSECONDS, ZERO, Vector3


class TorquePlayer(AnsweringWorker[PlayerParameters]):
    """Worker of the process `torque_player`."""

    def __init__(self) -> None:
        super().__init__("sst_torque_player", PlayerParameters, topics.PLAYER)
        self._profile, self._duration = _load(self.parameters)
        self._start_ns = 0  # stamp of the first sample
        self._last_ns = 0  # stamp of the last one
        # at its start a torque does not depend on how long it is held
        self._warned = self.parameters.hold != "middle"
        self.connect()

    def preview(self) -> Vector3:
        """Return the torque of the first hold [N m]."""
        return self._hold(0)

    def answer(self, state: JointState, stamp_ns: int) -> None:
        """Play the torque of the hold that a sample begins."""
        if not self.begun:
            self.begun = True
            self._start_ns = stamp_ns
            self._last_ns = stamp_ns
        elapsed_ns = stamp_ns - self._start_ns
        if elapsed_ns / NANOSECONDS < self._duration:
            self._check_period(stamp_ns)
            self.send(self._hold(elapsed_ns))
        else:
            self.send(ZERO)
            self.node.get_logger().info(
                f"the profile of {self._duration:g} s is played"
            )
            self.done.set()

    def _hold(self, elapsed_ns: int) -> Vector3:
        """Return torques [N m] from this time of the profile [ns].

        They are held until the next sample or the end of the profile.
        """
        parameters = self.parameters
        end_ns = round(self._duration * NANOSECONDS)
        hold_ns = min(parameters.period_ns, max(0, end_ns - elapsed_ns))
        time_ns: float = elapsed_ns
        if parameters.hold == "middle":
            time_ns += hold_ns / 2
        return self._profile.at(time_ns / NANOSECONDS)

    def _check_period(self, stamp_ns: int) -> None:
        """Warn once where the samples come at another period than that of `rate`."""
        apart_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        period_ns = self.parameters.period_ns
        if self._warned or apart_ns in (0, period_ns):
            return
        self._warned = True
        self.node.get_logger().warning(
            f"two samples are {apart_ns / NANOSECONDS:g} s apart, not 1 / rate ="
            f" {period_ns / NANOSECONDS:g} s: torques are not those of the middle of"
            " the hold; give rate = publish_rate of the simulator, or hold:=start"
        )


def _load(parameters: PlayerParameters) -> tuple[TorqueProfile, float]:
    if parameters.csv != "-":
        table = TorqueTable.read(parameters.csv)
        return table, float(table.times[-1])
    played = scene.load(parameters.scene)
    if played.torque is None or played.duration is None:
        requirement = (
            "must have torque and duration to be played, or csv must name a file"
        )
        raise refusal("torque_player", "scene", played.name, requirement)
    return played.torque, played.duration
