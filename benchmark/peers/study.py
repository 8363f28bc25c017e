# SPDX-License-Identifier: Apache-2.0
"""Gate, scout, time: who may be compared, which settings are worth it, and how long they take."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import numpy as np

from benchmark.peers.reference import SAMPLES, Reference, common
from benchmark.peers.series import Failed, Run, Series, Setting
from benchmark.peers.task import Pose, Task, apart
from benchmark.timing import interleaved

TARGETS = (1e-3, 1e-6, 1e-9)

Progress = Callable[[str, int, int], None]


@dataclass
class Point:
    """A setting and what came of it; errors are infinite where it failed.

    Attributes:
        error: of the orientation at the end [rad].
        largest: of the orientation at all samples that steps and reference share [rad].
        gamma: largest error of an actuator angle at the end [rad].
        seconds: processor time of the whole second, one a round; empty for what was not timed.

    """

    setting: Setting
    error: float
    largest: float
    gamma: float
    failed: str = ""
    seconds: list[float] = field(default_factory=list)

    @property
    def time(self) -> float:
        """Median processor time [s]."""
        return median(self.seconds) if self.seconds else math.nan


@dataclass
class Curve:
    """A series with the result of its gate, and its points."""

    series: Series
    gate: float
    points: list[Point] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return self.gate <= self.series.tolerance

    @property
    def front(self) -> list[Point]:
        """Timed points, fastest first, without those that are slower and no better."""
        found: list[Point] = []
        for point in sorted((p for p in self.points if p.seconds), key=lambda p: p.time):
            if not found or point.error < found[-1].error:
                found.append(point)
        return found


def studied(
    task: Task, reference: Reference, series: list[Series], rounds: int, progress: Progress
) -> list[Curve]:
    """Gate all, run all settings for their errors, then time the worthwhile ones in rounds."""
    curves = [Curve(one, _gate(one, task)) for one in series]
    runs: dict[int, Run] = {}
    total = sum(len(curve.series.settings) for curve in curves if curve.passed)
    done = 0
    for curve in curves:
        for setting in curve.series.settings if curve.passed else ():
            done += 1
            progress(f"errors: {curve.series.engine}", done, total)
            curve.points.append(_scouted(setting, reference, runs))
        _drop(curve, runs)
    points = {id(p): p for curve in curves for p in curve.points if id(p.setting) in runs}
    calls = {key: runs[id(point.setting)].whole for key, point in points.items()}
    seconds = interleaved(
        calls,
        rounds,
        progress=lambda a, b: progress("rounds of times", a, b),
        clock=time.process_time,
    )
    for key, point in points.items():
        point.seconds = seconds[key]
    return curves


def _gate(series: Series, task: Task) -> float:
    worst = series.gate(task)
    return worst if math.isfinite(worst) else math.inf


def _scouted(setting: Setting, reference: Reference, runs: dict[int, Run]) -> Point:
    nothing = (math.inf, math.inf, math.inf)
    try:
        run = setting.prepare()
        pieces = (common(setting.steps) if setting.steps else SAMPLES) if setting.samples else 1
        found = run.poses(pieces)
    except (Failed, ArithmeticError, ValueError, RuntimeError) as error:
        return Point(setting, *nothing, failed=str(error) or type(error).__name__)
    expected = [reference.poses[(piece + 1) * SAMPLES // pieces] for piece in range(pieces)]
    angles = [apart(a.rotation, b.rotation) for a, b in zip(found, expected, strict=True)]
    if not np.all(np.isfinite(angles)):
        return Point(setting, *nothing, failed="not finite")
    runs[id(setting)] = run
    return Point(setting, angles[-1], max(angles), _gamma(found[-1], expected[-1]))


def _gamma(found: Pose, expected: Pose) -> float:
    turn = found.gamma - expected.gamma
    return float(np.abs(turn - 2.0 * np.pi * np.round(turn / (2.0 * np.pi))).max())


def _drop(curve: Curve, runs: dict[int, Run]) -> None:
    """Leave only settings to be timed that no setting with as few steps beats."""
    best = math.inf
    for point in sorted(curve.points, key=lambda p: (p.setting.steps, p.error)):
        if point.setting.steps and point.error >= best:
            runs.pop(id(point.setting), None)
        best = min(best, point.error)


@dataclass(frozen=True)
class Reached:
    """How soon an error is reached.

    Attributes:
        time: of the fastest setting that is as good or better [s]; None where there is none.
        between: where the straight line in the log-log plot crosses the error [s], or None.
        point: that setting.

    """

    time: float | None
    between: float | None
    point: Point | None


def reached(curves: list[Curve], target: float) -> Reached:
    """Best over some curves."""
    good = [p for curve in curves for p in curve.front if p.error <= target]
    if not good:
        return Reached(None, None, None)
    point = min(good, key=lambda p: p.time)
    crossings = [x for curve in curves if (x := _crossing(curve.front, target)) is not None]
    return Reached(point.time, min(crossings, default=None), point)


def _crossing(front: list[Point], target: float) -> float | None:
    for worse, better in pairwise(front):
        if worse.error > target >= better.error:
            share = math.log(worse.error / target) / math.log(worse.error / better.error)
            return float(worse.time * (better.time / worse.time) ** share)
    return None
