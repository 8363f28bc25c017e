# SPDX-License-Identifier: Apache-2.0
"""How the error of feedforward alone falls with the period over which its torques are held."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import ReferenceMotion, Triple
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation
from sst_ros.studies.control_loop import ControlLoop, at_start, run_loop

EXACT_TOLERANCE = 1e-13
"""Local error of the simulation whose torques are a function of time."""

_SAMPLES = 20


@dataclass(frozen=True)
class HoldError:
    """Feedforward alone with an exact model, held over a period.

    Attributes:
        at: instant of the period whose torque is held: start or middle.
        period_s: the period [s].
        error: largest error of gamma over the motion [rad].

    """

    at: str
    period_s: float
    error: float


@dataclass(frozen=True)
class UnheldError:
    """Feedforward alone with an exact model, as a function of time: nothing is held.

    Attributes:
        error: largest error of gamma over the motion [rad].
        estimate: error estimate of the simulation at the end [rad].

    """

    error: float
    estimate: float


def held_error(loop: ControlLoop) -> HoldError:
    """Run a loop with feedforward alone."""
    settings = dataclasses.replace(loop.settings, mode="feedforward")
    track, _, failure = run_loop(dataclasses.replace(loop, settings=settings, rest_s=0.0))
    error = float("nan") if failure else float(np.abs(track.error).max())
    return HoldError(settings.feedforward_at, loop.period_ns / NANOSECONDS, error)


def unheld_error(scene: Scene, motion: ReferenceMotion) -> UnheldError:
    """Give a scene the torques of a motion as a function of time."""
    inverse = InverseDynamics(scene)

    def torque(time: float) -> Triple:
        now = motion.at(time)
        return inverse.torque(now.quaternion, now.body_rate, now.body_acceleration)

    simulation = Simulation(
        at_start(scene, motion), "dop853", tolerance=EXACT_TOLERANCE,
        step_budget=WHOLE_MOTION_BUDGET,
    )  # fmt: skip
    worst, step = 0.0, round(motion.duration * NANOSECONDS / _SAMPLES)
    for _ in range(_SAMPLES):
        state = simulation.step(torque, step)
        wanted = motion.at(state.time_ns / NANOSECONDS).gamma
        worst = max(worst, float(np.abs(np.subtract(wanted, state.joints.gamma)).max()))
    return UnheldError(worst, simulation.error_estimate)
