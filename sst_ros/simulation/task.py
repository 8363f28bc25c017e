# SPDX-License-Identifier: Apache-2.0
"""What is simulated, and when its tolerance is met: the same for steps and for collocation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque_profile import TorqueProfile
from sst_ros.state import NANOSECONDS

SAMPLES = 200
"""Intervals of a motion without `t_eval`."""

UNMET = 2
"""Status of a motion that reached its end with an error estimate above the tolerance."""


@dataclass(frozen=True)
class Task:
    """What is simulated."""

    scene: Scene
    torque: TorqueProfile
    span: int  # length of the motion [ns]
    period: int | None  # of control [ns]; None where torques are not held
    method: str  # name, or auto
    tolerance: float  # largest error estimate at the end [rad]
    breaks: Array  # further times at which the torques jump [s], ascending
    max_step: float  # longest step [s]
    times: np.ndarray | None  # of the samples [ns]; None for those that suit the method

    def sample_times(self) -> Array:
        """Return the times of the samples of a motion by steps [s]."""
        if self.times is not None:
            return np.asarray(self.times / NANOSECONDS)
        if self.period is not None:
            periods = np.arange(0, self.span, self.period, dtype=np.int64)
            return np.append(periods, self.span) / NANOSECONDS
        return np.unique(np.rint(np.linspace(0, self.span, SAMPLES + 1))) / NANOSECONDS

    def compare(self, error: float, status: int, message: str) -> tuple[int, str]:
        """Return status and message of a motion with an error estimate at its end [rad]."""
        if not error > self.tolerance:
            return status, message
        unmet = f"the error estimate {error:.1e} rad exceeds the tolerance {self.tolerance:g} rad"
        return status or UNMET, f"{message}; {unmet}"
