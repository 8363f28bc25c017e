# SPDX-License-Identifier: Apache-2.0
"""Trajectories by steps with error control, repeated until their error estimate is met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sst_ros.dynamics.initial_state import start_of
from sst_ros.integration.adaptive_stepper import WHOLE_MOTION_BUDGET
from sst_ros.integration.methods import DORMAND_PRINCE
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import describe_conditioning
from sst_ros.simulation.stepped_motion import SteppedMotion
from sst_ros.simulation.torque_profile import TorqueProfile, TorqueTable
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import NANOSECONDS

SAMPLES = 200
"""Intervals of a motion without `t_eval`."""

MOST_PERIODS = WHOLE_MOTION_BUDGET // (3 * len(DORMAND_PRINCE.a))
"""Control periods that the budget of a motion reaches: a step and its check are three steps."""

UNMET = 2
"""Status of a motion that reached its end with an error estimate above the tolerance."""

_ATTEMPTS, _FINEST = 4, 1e-14
"""Runs until the error estimate is at most the tolerance, and the least tolerance of a step."""


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


def integrate(task: Task, reason: str, progress: bool) -> Trajectory:
    """Run a motion by steps, again by smaller ones if its error estimate exceeds the tolerance.

    A function whose torques are held is called once a period and may have a memory: one run.
    `reason` says why this method was chosen, "" where the caller chose it.
    """
    local, spent = task.tolerance, 0
    for _ in range(_ATTEMPTS):
        motion = SteppedMotion(
            task.scene, task.torque, (0.0, task.span / NANOSECONDS), start_of(task.scene),
            task.sample_times(), method=task.method, tolerance=local, period=task.period,
            breaks=task.breaks, max_step=task.max_step, spent=spent, progress=progress,
        ).run()  # fmt: skip
        spent += motion.evaluations
        excess = motion.at.error / task.tolerance
        if task.period is not None or motion.status < 0 or not excess > 1.0:
            break
        local = max(local / (5.0 * excess), _FINEST)
    status, message, point = motion.status, motion.message, motion.at
    if status < 0:
        numbers = describe_conditioning(Geometry.of(task.scene), motion.state())
        message = f"{message} ({numbers})"
    if excess > 1.0:
        unmet = f"the error estimate {point.error:.1e} rad exceeds the tolerance"
        message = f"{message}; {unmet} {task.tolerance:g} rad"
        status = status or UNMET
    rows = np.array(motion.rows).reshape(-1, 29)
    changes = [f"{to} from {at:g} s ({why})" for at, to, why in point.changes]
    energy = motion.propagator.dynamics.total_energy
    return Trajectory(
        task.scene, rows[:, 0], rows[:, 1:5], rows[:, 5:8], rows[:, 8:11], joints=rows[:, 11:],
        status=status,
        message=message,
        method=", then ".join([motion.start.method.name, *changes]) + reason,
        error_estimate=point.error,
        energy_residual=energy(point.y) - energy(motion.start.y) - point.y[-1],
        evaluations=spent,
        step=motion.time / max(point.steps, 1),
        law=TorqueTable(*zip(*motion.held, strict=True)) if motion.held else task.torque,
    )  # fmt: skip
