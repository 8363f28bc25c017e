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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller_settings import INSTANTS, MODES, ControllerSettings
from sst_ros.control.reference import ReferenceMotion
from sst_ros.control.reference_motions import reference_motion
from sst_ros.control.tracking import TrackingMetrics, evaluate
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.studies.bandwidth_limits import BandwidthLimit, bandwidth_limit, ideal_plant
from sst_ros.studies.channel import Channel
from sst_ros.studies.control_loop import ControlLoop, run_loop
from sst_ros.studies.hold_order import HoldError, UnheldError, held_error, unheld_error
from sst_ros.studies.model_errors import SHARE, ModelError, model_errors
from sst_ros.studies.parallel import run_jobs
from sst_ros.studies.sampled_data import slope

REST_S = 0.3
"""Time for which a loop goes on after the motion, to see whether it settles [s]."""

OPEN_LOOP = "feedforward"
"""The mode that has no bandwidth."""

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
class LoopResult:
    """Result of one loop.

    Attributes:
        error: name of the model error.
        mode: of control.
        bandwidth: of the feedback [rad/s]; None where there is none.
        tracking: how well the motion was tracked; None for a failure.
        failure: why it failed; empty where it did not.

    """

    error: str
    mode: str
    bandwidth: float | None
    tracking: TrackingMetrics | None
    failure: str

    @property
    def rms(self) -> float | None:
        """Root of the mean square error of all gamma [rad]."""
        return None if self.tracking is None else float(np.sqrt(np.mean(self.tracking.rms**2)))


@dataclass(frozen=True)
class FeedforwardStudy:
    """Result of a study.

    Attributes:
        plan: its grid.
        seconds: length of the motion [s].
        left_out: errors that the plant cannot have.
        loops: by error, mode and bandwidth.
        holds: feedforward alone with an exact model, by instant and period.
        unheld: the same with torques as a function of time.
        limits: of the plant of the theory (`ideal_plant`), and of the plant as it is.

    """

    plan: FeedforwardPlan
    seconds: float
    left_out: tuple[str, ...]
    loops: tuple[LoopResult, ...]
    holds: tuple[HoldError, ...]
    unheld: UnheldError
    limits: tuple[tuple[BandwidthLimit, BandwidthLimit], ...]

    def of(self, error: str, mode: str, bandwidth: float | None) -> LoopResult:
        """Return the result of one loop, a failure where it was not tried."""
        key = (error, mode, None if mode == OPEN_LOOP else bandwidth)
        tried = (loop for loop in self.loops if (loop.error, loop.mode, loop.bandwidth) == key)
        return next(tried, LoopResult(*key, None, "not tried"))

    def benefit(self, error: str, bandwidth: float) -> float | None:
        """RMS(pd) / RMS(feedforward_pd) at equal gains; None where one of them failed."""
        pd, both = (self.of(error, mode, bandwidth).rms for mode in ("pd", "feedforward_pd"))
        return None if pd is None or not both else pd / both

    def least_benefit(self, error: str, bandwidth: float) -> float | None:
        """Return the bound of linear theory on the benefit where bodies weigh SHARE too much."""
        pd = self.of(error, "pd", bandwidth).rms
        exact = self.of("nominal", "feedforward_pd", bandwidth).rms
        return None if not pd or exact is None else 1.0 / (SHARE + exact / pd)

    def orders(self) -> dict[str, float]:
        """Power of the period with which the error of a hold falls, by instant."""
        found = {}
        for at in INSTANTS:
            holds = [(hold.period_s, hold.error) for hold in self.holds if hold.at == at]
            found[at] = slope(*zip(*holds, strict=True)) if len(holds) > 1 else float("nan")
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
    plants = (ideal_plant(scene), scene)
    # What takes longest comes first, so that no core waits for another at the end.
    limits: list[Callable[[], Any]] = [
        partial(_limit, plant, basic, plan.period_ns, delay)
        for delay in plan.delays for plant in plants
    ]  # fmt: skip
    loops = list(_loops(plan, basic, errors))
    holds = [
        partial(_held, scene, dataclasses.replace(basic, feedforward_at=at), plan.period_ns * n)
        for at in INSTANTS for n in plan.multiples
    ]  # fmt: skip
    jobs: list[Callable[[], Any]] = [*limits, *loops, partial(_unheld, scene), *holds]
    progress = f"{scene.name:<16}" if shown else ""
    found = run_jobs(_call, jobs, progress, workers)
    bounds, found = found[: len(limits)], found[len(limits) :]
    results, found = found[: len(loops)], found[len(loops) :]
    return FeedforwardStudy(
        plan, motion.duration, left_out, tuple(results), tuple(found[1:]), found[0],
        tuple(zip(bounds[::2], bounds[1::2], strict=True)),
    )  # fmt: skip


def _loops(
    plan: FeedforwardPlan, basic: ControllerSettings, errors: Sequence[ModelError]
) -> Iterator[Callable[[], LoopResult]]:
    for error in errors:
        model = error.model(plan.scene)
        for mode in MODES:
            for bandwidth in (None,) if mode == OPEN_LOOP else plan.bandwidths:
                settings = dataclasses.replace(basic, mode=mode)
                if bandwidth is not None:
                    settings = dataclasses.replace(settings, bandwidth=bandwidth)
                yield partial(
                    _tracked, error.name, bandwidth, plan.scene, model, settings, plan.period_ns,
                    error.channel, plan.seed,
                )  # fmt: skip


def _tracked(
    error: str,
    bandwidth: float | None,
    plant: Scene,
    model: Scene,
    settings: ControllerSettings,
    period_ns: int,
    channel: Channel,
    seed: int,
) -> LoopResult:
    motion = _motion(plant)
    loop = ControlLoop(plant, model, motion, settings, period_ns, channel, seed, rest_s=REST_S)
    track, limited, failure = run_loop(loop)
    found = None if failure else evaluate(track, int(limited.sum()))
    if found is not None and settings.mode != OPEN_LOOP:
        late = track.time >= motion.duration + 0.5 * REST_S
        failure = _restless(track.error[late], limited[late], found.band)
    return LoopResult(error, settings.mode, bandwidth, None if failure else found, failure)


def _restless(error: Array, limited: NDArray[np.bool_], band: float) -> str:
    """Return why a loop with feedback does not rest long after the motion; empty if it does."""
    swing = float(np.ptp(error, axis=0).max())
    if not limited.any() and swing <= band:
        return ""
    saturated = ", torques at their limit" if limited.any() else ""
    return f"{RESTLESS}: swings by {swing:.1g} rad{saturated}"


def _limit(
    plant: Scene, settings: ControllerSettings, period_ns: int, delay: int
) -> BandwidthLimit:
    channel = Channel(delay=delay)
    return bandwidth_limit(ControlLoop(plant, plant, _motion(plant), settings, period_ns, channel))


def _held(plant: Scene, settings: ControllerSettings, period_ns: int) -> HoldError:
    return held_error(ControlLoop(plant, plant, _motion(plant), settings, period_ns))


def _unheld(plant: Scene) -> UnheldError:
    return unheld_error(plant, _motion(plant))


@lru_cache(maxsize=4)
def _motion(scene: Scene) -> ReferenceMotion:
    from sst_ros.recording.recorded_motion import samples

    return reference_motion(scene, samples)


def _call(job: Callable[[], Any]) -> Any:
    return job()
