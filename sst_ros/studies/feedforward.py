# SPDX-License-Identifier: Apache-2.0
"""How good feedforward is: every mode of control against everything that may be wrong.

Loops run in lockstep on `Simulation`: state at the start of a period, command, one step under it.
All have the plant of one scene and its desired motion; what the controller has wrong is its own
model, or the channel between them (`model_errors`).

**What to expect.** With a right model the error of feedforward alone is that of the hold, and
falls with the period as `sampled` says. With equal gains, the error of gamma obeys one linear
equation as long as it is small, driven by the torque that the feedforward lacks: all of it for pd,
the share s of a model whose bodies weigh 1 +- s times too much for feedforward_pd. So

    RMS(pd) / RMS(feedforward_pd) -> 1 / s = 5 for s = 20 %,

and, as the hold adds to the error what a right model leaves, it is by the triangle inequality no
less than 1 / (s + RMS(feedforward_pd, right model) / RMS(pd)). Friction, which the model has right,
and the curvature of the mechanism move it by some per cent. Computed torque is stable up to the
bandwidth that `sampled` tells.
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
from sst_ros.studies.bandwidth import Limit, ideal, limit
from sst_ros.studies.channel import Channel
from sst_ros.studies.control_loop import Loop, follow
from sst_ros.studies.hold_order import Exact, Hold, exact, held
from sst_ros.studies.model_errors import SHARE, ModelError, model_errors
from sst_ros.studies.parallel import evaluate_grid

REST_S = 0.3
"""Time for which a loop goes on after the motion, to see whether it settles [s]."""

OPEN_LOOP = "feedforward"
"""The mode that has no bandwidth."""

RESTLESS = "does not come to rest"
"""A failure: the loop is unstable, or what it measures is too coarse for its gains."""


@dataclass(frozen=True)
class Plan:
    """What a study tries.

    Attributes:
        scene: the plant, with its desired motion.
        period_ns: control period [ns].
        bandwidths: of the feedback [rad/s].
        damping_ratio: of the feedback.
        seed: of all noise; every loop draws the same numbers.
        errors: what the controller has wrong.
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
class Outcome:
    """What came of one loop.

    Attributes:
        error: what the controller had wrong.
        mode: of control.
        bandwidth: of the feedback [rad/s]; None where there is none.
        tracking: how well the motion was followed; None for a failure.
        failure: what went wrong; empty where nothing did.

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
class Study:
    """Everything that was found out.

    Attributes:
        plan: what was asked.
        seconds: length of the motion [s].
        left_out: errors that the plant cannot have.
        outcomes: by error, mode and bandwidth.
        holds: feedforward alone with a right model, by instant and period.
        exact: the same with torques as a function of time.
        limits: of the plant that theory has (`limits.ideal`), and of the plant as it is.

    """

    plan: Plan
    seconds: float
    left_out: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    holds: tuple[Hold, ...]
    exact: Exact
    limits: tuple[tuple[Limit, Limit], ...]

    def of(self, error: str, mode: str, bandwidth: float | None) -> Outcome:
        """Return what came of one loop, a failure where it was not tried."""
        asked = (error, mode, bandwidth)
        tried = (o for o in self.outcomes if (o.error, o.mode, o.bandwidth) == asked)
        return next(tried, Outcome(*asked, None, "not tried"))

    def benefit(self, error: str, bandwidth: float) -> float | None:
        """RMS(pd) / RMS(feedforward_pd) at equal gains; None where one of them failed."""
        pd, both = (self.of(error, mode, bandwidth).rms for mode in ("pd", "feedforward_pd"))
        return None if pd is None or not both else pd / both

    def least_benefit(self, error: str, bandwidth: float) -> float | None:
        """Return what linear theory says of the benefit where bodies weigh SHARE too much."""
        pd = self.of(error, "pd", bandwidth).rms
        right = self.of("nominal", "feedforward_pd", bandwidth).rms
        return None if not pd or right is None else 1.0 / (SHARE + right / pd)


def study(plan: Plan, *, workers: int | None = None, shown: bool = False) -> Study:
    """Try everything, on all cores; the same bits for any number of workers.

    Raises:
        InputError: the scene has no desired motion, or one that cannot be made.
        SingularConfiguration: a singularity lies in the way.

    """
    scene, motion = plan.scene, _motion(plan.scene)
    errors = [error for error in plan.errors if error.name == "nominal" or error.changes(scene)]
    left_out = tuple(error.name for error in plan.errors if error not in errors)
    basic = ControllerSettings(damping_ratio=plan.damping_ratio)
    plants = (ideal(scene), scene)
    # What takes longest comes first, so that no core waits for another at the end.
    limits = [
        partial(_limit, plant, basic, plan.period_ns, delay)
        for delay in plan.delays for plant in plants
    ]  # fmt: skip
    loops = list(_loops(plan, basic, errors))
    holds = [
        partial(_held, scene, dataclasses.replace(basic, feedforward_at=at), plan.period_ns * n)
        for at in INSTANTS for n in plan.multiples
    ]  # fmt: skip
    questions: list[Callable[[], Any]] = [*limits, *loops, partial(_exact, scene), *holds]
    found = evaluate_grid(
        _asked, questions, workers=workers, label=f"{scene.name:<16}", shown=shown
    )
    bounds, found = found[: len(limits)], found[len(limits) :]
    outcomes, found = found[: len(loops)], found[len(loops) :]
    return Study(
        plan, motion.duration, left_out, tuple(outcomes), tuple(found[1:]), found[0],
        tuple(zip(bounds[::2], bounds[1::2], strict=True)),
    )  # fmt: skip


def _loops(
    plan: Plan, basic: ControllerSettings, errors: Sequence[ModelError]
) -> Iterator[Callable[[], Outcome]]:
    for error in errors:
        model = error.model(plan.scene)
        for mode in MODES:
            for bandwidth in (None,) if mode == OPEN_LOOP else plan.bandwidths:
                settings = dataclasses.replace(basic, mode=mode)
                if bandwidth is not None:
                    settings = dataclasses.replace(settings, bandwidth=bandwidth)
                yield partial(
                    _outcome, error.name, bandwidth, plan.scene, model, settings, plan.period_ns,
                    error.channel, plan.seed,
                )  # fmt: skip


def _outcome(
    error: str,
    bandwidth: float | None,
    plant: Scene,
    model: Scene,
    settings: ControllerSettings,
    period_ns: int,
    channel: Channel,
    seed: int,
) -> Outcome:
    motion = _motion(plant)
    loop = Loop(plant, model, motion, settings, period_ns, channel, seed, rest_s=REST_S)
    track, limited, failure = follow(loop)
    found = None if failure else evaluate(track, int(limited.sum()))
    if found is not None and settings.mode != OPEN_LOOP:
        late = track.time >= motion.duration + 0.5 * REST_S
        failure = _restless(track.error[late], limited[late], found.band)
    return Outcome(error, settings.mode, bandwidth, None if failure else found, failure)


def _restless(error: Array, limited: NDArray[np.bool_], band: float) -> str:
    """Tell that a loop with feedback does not rest long after the motion; empty if it does."""
    swing = float(np.ptp(error, axis=0).max())
    if not limited.any() and swing <= band:
        return ""
    told = ", torques at their limit" if limited.any() else ""
    return f"{RESTLESS}: swings by {swing:.1g} rad{told}"


def _limit(plant: Scene, settings: ControllerSettings, period_ns: int, delay: int) -> Limit:
    return limit(Loop(plant, plant, _motion(plant), settings, period_ns, Channel(delay=delay)))


def _held(plant: Scene, settings: ControllerSettings, period_ns: int) -> Hold:
    return held(Loop(plant, plant, _motion(plant), settings, period_ns))


def _exact(plant: Scene) -> Exact:
    return exact(plant, _motion(plant))


@lru_cache(maxsize=4)
def _motion(scene: Scene) -> ReferenceMotion:
    from sst_ros.recording.recorded_motion import samples

    return reference_motion(scene, samples)


def _asked(question: Callable[[], Any]) -> Any:
    return question()
