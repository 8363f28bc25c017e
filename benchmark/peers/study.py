# SPDX-License-Identifier: Apache-2.0
"""Error against processor time of every series that passes its gate.

An engine brings series: a gate, and settings that can be run. Every setting runs once for its
error; those that no setting with as few steps beats are then timed in rounds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from benchmark.measure import time_in_turn
from benchmark.peers.task import DURATION, Moving, Pose, Task, find_relative, turn_between
from sst_ros.report.reference_solution import InitialValueProblem, solve_reference

TARGETS = (1e-3, 1e-6, 1e-9)
SAMPLES = 20
"""The reference is known at the multiples of DURATION / SAMPLES."""

Progress = Callable[[str, int, int], None]


class Run(NamedTuple):
    """A setting that is ready to go; both start anew each time.

    Attributes:
        whole: do the second, leave the end in the engine's own terms. This is what is timed.
        poses: do it in so many equal pieces and tell the pose at the end of each.

    """

    whole: Callable[[], Any]
    poses: Callable[[int], list[Pose]]


class Failed(Exception):
    """A run that has no result; says why."""


@dataclass(frozen=True)
class Setting:
    """One way to run.

    Attributes:
        label: for people.
        steps: how many, all of one length; 0 where they are adaptive.
        prepare: builds what is needed; it is not timed.
        samples: False where only the pose at the end can be had.

    """

    label: str
    steps: int
    prepare: Callable[[], Run]
    samples: bool = True


@dataclass(frozen=True)
class Series:
    """One engine by one method.

    Attributes:
        engine: whose times are taken together for "best setting".
        name: short name.
        python: where Python is interpreted.
        tolerance: largest relative difference of gamma_ddot at the moving states.
        acceleration: gamma_ddot of the engine at a moving state.
        settings: what is swept.

    """

    engine: str
    name: str
    python: str
    tolerance: float
    acceleration: Callable[[Moving], np.ndarray]
    settings: Sequence[Setting] = field(default_factory=list)

    def gate(self, task: Task) -> float:
        """Largest relative difference to the paper's equations at the moving states."""
        largest = max(find_relative(self.acceleration(at), at.answer) for at in task.moving)
        return largest if math.isfinite(largest) else math.inf


def make_ladder(first: float, last: float, factor: float) -> list[int]:
    """Step counts from first to last, each about `factor` times the one before."""
    counts, now = [], float(first)
    while now <= last * 1.001:
        count = round(now) if now < 40 else 20 * round(now / 20)
        if count not in counts:
            counts.append(count)
        now *= factor
    return counts


@dataclass(frozen=True)
class Reference:
    """Poses by sample number 1 .. SAMPLES, their own error [rad], and how they were found."""

    poses: dict[int, Pose]
    error: float
    how: str


def solve_task(task: Task) -> Reference:
    """Solve the task in extended precision."""
    problem = InitialValueProblem(task.scene)
    if (problem.count, problem.seconds) != (SAMPLES, DURATION):
        raise RuntimeError("the reference is known at other times")
    found = solve_reference(problem, compiled=True)
    poses = {
        k: task.pose_of(found.states[k, :7].astype(float).tolist()) for k in range(1, SAMPLES + 1)
    }
    return Reference(poses, found.own.orientation, found.how)


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


def run_study(
    task: Task, reference: Reference, series: list[Series], rounds: int, progress: Progress
) -> list[Curve]:
    """Gate all, run all settings for their errors, then time the worthwhile ones in rounds."""
    curves = [Curve(one, one.gate(task)) for one in series]
    passed = [curve for curve in curves if curve.passed]
    total = sum(len(curve.series.settings) for curve in passed)
    calls: dict[int, Callable[[], Any]] = {}
    points: dict[int, Point] = {}
    for curve in passed:
        runs: dict[int, Run] = {}
        for setting in curve.series.settings:
            done = sum(len(one.points) for one in passed) + 1
            progress(f"errors: {curve.series.engine}", done, total)
            curve.points.append(_try(setting, reference, runs))
        best = math.inf
        for point in sorted(curve.points, key=lambda p: (p.setting.steps, p.error)):
            beaten = point.setting.steps and point.error >= best
            if id(point.setting) in runs and not beaten:
                calls[id(point)], points[id(point)] = runs[id(point.setting)].whole, point
            best = min(best, point.error)
    seconds = time_in_turn(
        calls,
        rounds,
        progress=lambda a, b: progress("rounds of times", a, b),
        clock=time.process_time,
    )
    for key, point in points.items():
        point.seconds = seconds[key]
    return curves


def _try(setting: Setting, reference: Reference, runs: dict[int, Run]) -> Point:
    """Run a setting once for its errors; keep what was prepared in `runs`."""
    nothing = (math.inf, math.inf, math.inf)
    try:
        run = setting.prepare()
        pieces = math.gcd(setting.steps, SAMPLES) if setting.samples else 1
        found = run.poses(pieces)
    except (Failed, ArithmeticError, ValueError, RuntimeError) as error:
        return Point(setting, *nothing, failed=str(error) or type(error).__name__)
    expected = [reference.poses[(piece + 1) * SAMPLES // pieces] for piece in range(pieces)]
    angles = [turn_between(a.rotation, b.rotation) for a, b in zip(found, expected, strict=True)]
    if not np.all(np.isfinite(angles)):
        return Point(setting, *nothing, failed="not finite")
    runs[id(setting)] = run
    turn = found[-1].gamma - expected[-1].gamma
    turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    return Point(setting, angles[-1], max(angles), float(np.abs(turn).max()))


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


def reach(curves: list[Curve], target: float) -> Reached:
    """Best over some curves."""
    good = [p for curve in curves for p in curve.front if p.error <= target]
    if not good:
        return Reached(None, None, None)
    point = min(good, key=lambda p: p.time)
    crossings = []
    for curve in curves:
        for rough, fine in pairwise(curve.front):
            if rough.error > target >= fine.error:
                share = math.log(rough.error / target) / math.log(rough.error / fine.error)
                crossings.append(float(rough.time * (fine.time / rough.time) ** share))
                break
    return Reached(point.time, min(crossings, default=None), point)
