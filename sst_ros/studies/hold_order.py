# SPDX-License-Identifier: Apache-2.0
"""How the error of feedforward alone falls with the period over which its torques are held."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import ReferenceMotion, Triple
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation
from sst_ros.studies.control_loop import Loop, follow, started

EXACT_TOLERANCE = 1e-13
"""Local error of the simulation whose torques are a function of time."""

_SAMPLES = 20


@dataclass(frozen=True)
class Hold:
    """Feedforward alone with an exact model, held over a period.

    Attributes:
        at: instant of the period whose torque is held, start or middle.
        period_s: the period [s].
        error: largest error of gamma over the motion [rad].

    """

    at: str
    period_s: float
    error: float


@dataclass(frozen=True)
class Exact:
    """Feedforward alone with an exact model, as a function of time: nothing is held.

    Attributes:
        error: largest error of gamma over the motion [rad].
        estimate: what the simulation says of its own error at the end [rad].

    """

    error: float
    estimate: float


def held(loop: Loop) -> Hold:
    """Run a loop with feedforward alone."""
    settings = dataclasses.replace(loop.settings, mode="feedforward")
    track, _, failure = follow(dataclasses.replace(loop, settings=settings, rest_s=0.0))
    error = float("nan") if failure else float(np.abs(track.error).max())
    return Hold(settings.feedforward_at, loop.period_ns / NANOSECONDS, error)


def exact(scene: Scene, motion: ReferenceMotion) -> Exact:
    """Give a scene the torques of a motion as a function of time."""
    inverse = InverseDynamics(scene)

    def torque(time: float) -> Triple:
        now = motion.at(time)
        return inverse.torque(now.quaternion, now.body_rate, now.body_acceleration)

    simulation = Simulation(
        started(scene, motion), "dop853", tolerance=EXACT_TOLERANCE, step_budget=WHOLE_MOTION_BUDGET
    )
    worst, step = 0.0, round(motion.duration * NANOSECONDS / _SAMPLES)
    for _ in range(_SAMPLES):
        state = simulation.step(torque, step)
        wanted = motion.at(state.time_ns / NANOSECONDS).gamma
        worst = max(worst, float(np.abs(np.subtract(wanted, state.joints.gamma)).max()))
    return Exact(worst, simulation.error_estimate)
