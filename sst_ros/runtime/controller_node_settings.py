# SPDX-License-Identifier: Apache-2.0
"""Parameters of the inverse-dynamics controller: those of the control law and those of the node."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sst_ros.control.controller_settings import ControllerSettings
from sst_ros.errors import Problem
from sst_ros.scene.schema import choice, flag, integer, number, text
from sst_ros.simulation.simulation import NANOSECONDS


@dataclass(frozen=True)
class ControllerNodeParameters(ControllerSettings):
    """Parameters of sst_inverse_dynamics."""

    scene: str = text("scene of the controller's model, by name or by path", default="reach")
    motion: str = choice(
        "scene: the scene's motion, once; topic: trajectories from ~/joint_trajectory, until it is "
        "stopped",
        ("scene", "topic"),
        default="scene",
    )
    hold: float = number(
        "time for which the end of the scene's motion is held",
        "s",
        default=0.0,
        least=0.0,
        most=1e6,
    )
    rate: int = integer(
        "commands per second of simulated time, a divisor of 1e9: publish_rate of the simulator",
        "Hz",
        default=500,
        least=1,
        most=100000,
    )
    start_tolerance: float = number(
        "largest distance of gamma from the start of the motion",
        "rad",
        default=0.05,
        above=0.0,
        most=1.0,
    )
    simulator: str = text("name of the simulator's node", default="sst_simulator")
    stamped: bool = flag(
        "answer on commands_stamped, as a simulator in lockstep asks", default=False
    )
    min_subscribers: int = integer(
        "least number of subscribers of the commands, before which none is sent",
        "1",
        default=1,
        least=1,
        most=100,
    )
    wait_for_recorder: bool = flag(
        "start when ~/reference and ~/tracking_error have subscribers, for a complete recording",
        default=False,
    )
    timeout: float = number(
        "longest silence of joint_states", "s", default=10.0, least=0.1, most=1e6
    )

    def check(self) -> Iterator[Problem]:
        """Refuse a rate without a whole period."""
        yield from super().check()
        if NANOSECONDS % self.rate:
            yield Problem("rate", self.rate, "must divide 1e9, so that a period is whole")

    @property
    def period_s(self) -> float:
        """Time from one command to the next [s]."""
        return 1.0 / self.rate
