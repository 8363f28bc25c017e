# SPDX-License-Identifier: Apache-2.0
"""How good feedforward is: every control mode with every model error, as a grid.

Loops run in lockstep on `Simulation`: state at the start of a period, command, one step under it.
All have the plant of one scene and its reference motion; the errors are in the controller's model,
or in the channel between them (`model_errors`).

**Theory.** With an exact model the error of feedforward alone is that of the hold, and falls with
the period as `sampled_data` derives. With equal gains, the error of gamma obeys one linear equation
as long as it is small, driven by the torque that the feedforward lacks: all of it for pd, the share
s of a model whose bodies weigh 1 +- s times too much for feedforward_pd. So

    RMS(pd) / RMS(feedforward_pd) -> 1 / s = 5 for s = 20 %,

and, as the hold adds the error of an exact model, it is by the triangle inequality no less than
1 / (s + RMS(feedforward_pd, exact model) / RMS(pd)). Friction, which the model has right, and the
curvature of the mechanism change it by some per cent. Computed torque is stable up to the bandwidth
of `sampled_data.stability_limit`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import methodcaller
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller_settings import INSTANTS, MODES, ControllerSettings
from sst_ros.control.reference import ReferenceMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.control.tracking import evaluate
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS
from sst_ros.studies.bandwidth_limits import bandwidth_in_theory, bandwidth_limit, ideal_plant
from sst_ros.studies.control_loop import Channel, ControlLoop, held_error, run_loop, unheld_error
from sst_ros.studies.model_errors import SHARE, ModelError, model_errors
from sst_ros.studies.results import table
from sst_ros.studies.sampled_data import slope
from sst_ros.sweeps.job_list import run_jobs

if TYPE_CHECKING:
    from pandas import DataFrame

REST_S = 0.3
"""Time for which a loop goes on after the motion, to see whether it settles [s]."""

OPEN_LOOP = "feedforward"  # the mode that has no bandwidth

COLUMNS = (
    "scene", "error", "mode", "bandwidth_rad_per_s", "damping_ratio", "period_s", "seed",
    "rms_rad", "largest_rad", "settling_s", "torque_rms_Nm", "torque_largest_Nm",
    "feedforward_share", "feedback_share", "samples_limited", "failure",
)  # fmt: skip
"""Columns of the table of loops; those from rms_rad on are empty for a failure."""

RESTLESS = "does not come to rest"
"""A failure: the loop is unstable, or its measurements are too coarse for its gains."""


@dataclass(frozen=True)
class FeedforwardPlan:
    """The grid of a study.

    Attributes:
        scene: the plant, with its reference motion.
        period_ns: control period [ns].
        bandwidths: of the feedback [rad/s].
        damping_ratio: of the feedback.
        seed: of all noise; every loop draws the same numbers.
        errors: model errors.
        multiples: periods for the order of the hold, in control periods.
        delays: samples, for the limits of the bandwidth.

    """

    scene: Scene
    period_ns: int = 1_000_000
    bandwidths: tuple[float, ...] = (20.0, 60.0, 180.0)
    damping_ratio: float = 1.0
    seed: int = 8
    errors: tuple[ModelError, ...] = tuple(model_errors())
    multiples: tuple[int, ...] = (1, 2, 4, 8)
    delays: tuple[int, ...] = (0, 1, 2, 3, 4, 5)


@dataclass(frozen=True)
class FeedforwardStudy:
    """Result of a study.

    Attributes:
        plan: its grid.
        seconds: length of the motion [s].
        left_out: errors that the plant cannot have.
        loops: a row for each error, mode and bandwidth, columns as in COLUMNS.
        holds: feedforward alone, exact model: instant `at` of the torque that is held, period_s,
            largest error of gamma [rad].
        unheld: the same with torques as a function of time: error, and its estimate [rad].
        limits: largest stable bandwidths of computed torque [rad/s] by delay in samples: theory,
            ideal (the plant of the theory), real (the plant as it is).

    """

    plan: FeedforwardPlan
    seconds: float
    left_out: tuple[str, ...]
    loops: DataFrame
    holds: DataFrame
    unheld: tuple[float, float]
    limits: DataFrame

    def rms(self, error: str, mode: str, bandwidth: float) -> float | None:
        """Root of the mean square error of all gamma [rad]; None where the loop failed."""
        rows = self.loops[(self.loops.error == error) & (self.loops["mode"] == mode)]
        if mode != OPEN_LOOP:
            rows = rows[rows.bandwidth_rad_per_s == bandwidth]
        known = rows.rms_rad.dropna()
        return None if known.empty else float(known.iloc[0])

    def benefit(self, error: str, bandwidth: float) -> float | None:
        """RMS(pd) / RMS(feedforward_pd) at equal gains; None where one of them failed."""
        pd, both = (self.rms(error, mode, bandwidth) for mode in ("pd", "feedforward_pd"))
        return None if pd is None or not both else pd / both

    def least_benefit(self, error: str, bandwidth: float) -> float | None:
        """Return the bound of linear theory on the benefit where bodies weigh SHARE too much."""
        pd = self.rms(error, "pd", bandwidth)
        exact = self.rms("nominal", "feedforward_pd", bandwidth)
        return None if not pd or exact is None else 1.0 / (SHARE + exact / pd)

    def orders(self) -> dict[str, float]:
        """Power of the period with which the error of a hold falls, by instant."""
        found = {}
        for at, holds in self.holds.groupby("at", sort=False):
            errors = holds.period_s.tolist(), holds.error.tolist()
            found[str(at)] = slope(*errors) if len(holds) > 1 else float("nan")
        return found


def feedforward_study(
    plan: FeedforwardPlan, *, workers: int | None = None, shown: bool = False
) -> FeedforwardStudy:
    """Run the grid on all cores; the same bits for any number of workers.

    Raises:
        InputError: the scene has no reference motion, or one that cannot be made.
        SingularConfiguration: a singularity lies on the path.

    """
    scene, motion = plan.scene, _motion(plan.scene)
    errors = [error for error in plan.errors if error.name == "nominal" or error.changes(scene)]
    left_out = tuple(error.name for error in plan.errors if error not in errors)
    basic = ControllerSettings(damping_ratio=plan.damping_ratio)
    # What takes longest comes first, so that no core waits for another at the end.
    jobs: list[Callable[[], Any]] = [
        partial(_limit, scene, basic, plan.period_ns, delay) for delay in plan.delays
    ]
    schemes = [
        dataclasses.replace(basic, mode=mode, bandwidth=bandwidth)
        for mode in MODES
        for bandwidth in ((basic.bandwidth,) if mode == OPEN_LOOP else plan.bandwidths)
    ]
    jobs += [partial(_tracked, plan, error, settings) for error in errors for settings in schemes]
    jobs += [
        partial(_held, scene, dataclasses.replace(basic, feedforward_at=at), plan.period_ns * n)
        for at in INSTANTS for n in plan.multiples
    ]  # fmt: skip
    jobs.append(partial(_unheld, scene))
    found = run_jobs(methodcaller("__call__"), jobs, f"{scene.name:<16}" if shown else "", workers)
    limits, holds = len(plan.delays), len(INSTANTS) * len(plan.multiples)
    return FeedforwardStudy(
        plan, motion.duration, left_out, table(found[limits : -holds - 1], COLUMNS),
        table(found[-holds - 1 : -1]), found[-1],
        table(found[:limits], ("delay", "theory", "ideal", "real")),
    )  # fmt: skip


def _tracked(
    plan: FeedforwardPlan, error: ModelError, settings: ControllerSettings
) -> dict[str, Any]:
    """Run a loop: its row of the table."""
    motion, open_loop = _motion(plan.scene), settings.mode == OPEN_LOOP
    named = {
        "scene": plan.scene.name, "error": error.name, "mode": settings.mode,
        "bandwidth_rad_per_s": None if open_loop else settings.bandwidth,
        "damping_ratio": plan.damping_ratio, "period_s": plan.period_ns / NANOSECONDS,
        "seed": plan.seed,
    }  # fmt: skip
    track, limited, failure = run_loop(
        ControlLoop(
            plan.scene, error.model(plan.scene), motion, settings, plan.period_ns, error.channel,
            plan.seed, rest_s=REST_S,
        )
    )  # fmt: skip
    if failure:
        return named | {"failure": failure}
    found = evaluate(track, int(limited.sum()))
    late = track.time >= motion.duration + 0.5 * REST_S
    if failure := "" if open_loop else _restless(track.error[late], limited[late], found.band):
        return named | {"failure": failure}
    power = found.torque_rms**2
    shares = [
        float(np.nansum(share * power) / power.sum()) if power.any() else None
        for share in (found.feedforward, found.feedback)
    ]
    numbers = (
        float(np.sqrt(np.mean(found.rms**2))), float(found.largest.max()), found.settling,
        float(np.sqrt(power.mean())), float(found.torque_largest.max()), *shares, found.limited, "",
    )  # fmt: skip
    return named | dict(zip(COLUMNS[len(named) :], numbers, strict=True))


def _restless(error: Array, limited: NDArray[np.bool_], band: float) -> str:
    """Return why a loop with feedback does not rest long after the motion; empty if it does."""
    swing = float(np.ptp(error, axis=0).max())
    if not limited.any() and swing <= band:
        return ""
    saturated = ", torques at their limit" if limited.any() else ""
    return f"{RESTLESS}: swings by {swing:.1g} rad{saturated}"


def _limit(
    plant: Scene, settings: ControllerSettings, period_ns: int, delay: int
) -> dict[str, Any]:
    ideal, real = (
        ControlLoop(each, each, _motion(each), settings, period_ns, Channel(delay=delay))
        for each in (ideal_plant(plant), plant)
    )
    return {"delay": delay, "theory": bandwidth_in_theory(real), "ideal": bandwidth_limit(ideal),
            "real": bandwidth_limit(real)}  # fmt: skip


def _held(plant: Scene, settings: ControllerSettings, period_ns: int) -> dict[str, Any]:
    error = held_error(ControlLoop(plant, plant, _motion(plant), settings, period_ns))
    return {"at": settings.feedforward_at, "period_s": period_ns / NANOSECONDS, "error": error}


def _unheld(plant: Scene) -> tuple[float, float]:
    return unheld_error(plant, _motion(plant))


@lru_cache(maxsize=4)
def _motion(scene: Scene) -> ReferenceMotion:
    from sst_ros.recording.recorded_motion import samples

    return reference_motion(scene, samples)
