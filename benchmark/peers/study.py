# SPDX-License-Identifier: Apache-2.0
"""Error against processor time of every series that passes its gate.

An engine brings series: a gate, and settings that can be run. Every setting runs once
for its error; those that no setting with as few steps beats are then timed in rounds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from benchmark.measure import time_in_turn
from benchmark.peers.task import (
    DURATION,
    Moving,
    Pose,
    Task,
    find_relative,
    turn_between,
)
from sst_ros.progress import slices
from sst_ros.report.reference_solution import InitialValueProblem, solve_reference

TARGETS = (1e-3, 1e-6, 1e-9)


class Failed(Exception):
    """A run that has no result; says why."""


class Engine:
    """An engine with the mechanism in it at one setting.

    All that it needs is made beforehand.

    Attributes:
        run: do the second from its start; this is timed.
        pose: where a run has ended, of what `run` returned.
    """

    run: Callable[[], Any]
    pose: Callable[[Any], Pose]


@dataclass(frozen=True)
class Setting:
    """One way to run.

    Attributes:
        label: for people.
        steps: how many, all of one length; 0 where they are adaptive.
        make: gives the engine, ready to run.

    """

    label: str
    steps: int
    make: Callable[[], Engine]


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
    settings: Sequence[Setting] = ()

    def gate(self, task: Task) -> float:
        """Largest relative difference to the paper's equations at the moving states."""
        largest = max(
            find_relative(self.acceleration(at), at.answer) for at in task.moving
        )
        return largest if math.isfinite(largest) else math.inf


def list_steps(
    first: float,
    last: float,
    factor: float,
    make: Callable[[int], Engine],
    note: str = "",
) -> list[Setting]:
    """Return settings from the first number of steps to the last, each about `factor`
    finer.
    """
    counts, now = [], float(first)
    while now <= last * 1.001:
        counts.append(round(now) if now < 40 else 20 * round(now / 20))
        now *= factor
    return [
        Setting(f"{count} steps{note}", count, partial(make, count))
        for count in dict.fromkeys(counts)
    ]


@dataclass(frozen=True)
class Reference:
    """The pose at the end, its own error [rad], and how it was found."""

    pose: Pose
    error: float
    how: str


def solve_task(task: Task) -> Reference:
    """Solve the task in extended precision."""
    problem = InitialValueProblem(task.scene)
    if problem.seconds != DURATION:
        raise RuntimeError("the reference is known at another time")
    found = solve_reference(problem)
    end = task.pose_of(found.states[-1, :7].astype(float).tolist())
    return Reference(end, found.own.orientation, found.how)


@dataclass
class Point:
    """A setting and what came of it; errors are infinite where it failed.

    Attributes:
        error: of the orientation at the end [rad].
        gamma: largest error of an actuator angle at the end [rad].
        seconds: processor time of the whole second, one a round; empty for what was not
            timed.
    """

    setting: Setting
    error: float = math.inf
    gamma: float = math.inf
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


def run_study(
    task: Task, reference: Reference, series: list[Series], rounds: int
) -> list[Curve]:
    """Gate all, run all settings for their errors, then time the worthwhile ones in
    rounds.
    """
    curves = [Curve(one, one.gate(task)) for one in series]
    passed = [curve for curve in curves if curve.passed]
    calls: dict[int, Callable[[], Any]] = {}
    points: dict[int, Point] = {}
    for curve in passed:
        settings, label = curve.series.settings, f"{curve.series.engine}: errors"
        parts = slices(len(settings), 1, label, True)
        tried = [_try(settings[part.start], reference) for part in parts]
        best = math.inf
        for point, engine in sorted(
            tried, key=lambda both: (both[0].setting.steps, both[0].error)
        ):
            if engine is not None and (not point.setting.steps or point.error < best):
                calls[id(point)], points[id(point)] = engine.run, point
            best = min(best, point.error)
        curve.points += [point for point, _ in tried]
    seconds = time_in_turn(calls, rounds, clock=time.process_time, shown=True)
    for key, point in points.items():
        point.seconds = seconds[key]
    return curves


def _try(setting: Setting, reference: Reference) -> tuple[Point, Engine | None]:
    """Run a setting once for its errors; also return what was made for it."""
    try:
        engine = setting.make()
        found = engine.pose(engine.run())
        if not np.all(np.isfinite(found.rotation)):
            raise Failed("not finite")
    except (Failed, ArithmeticError, ValueError, RuntimeError) as error:
        return Point(setting, failed=str(error) or type(error).__name__), None
    turn = found.gamma - reference.pose.gamma
    turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
    angle = turn_between(found.rotation, reference.pose.rotation)
    return Point(setting, angle, float(np.abs(turn).max())), engine


def reach(curves: list[Curve], target: float) -> Point | None:
    """Return the fastest setting of some curves whose error is at most the target."""
    good = [
        p for curve in curves for p in curve.points if p.seconds and p.error <= target
    ]
    return min(good, key=lambda point: point.time, default=None)
