# SPDX-License-Identifier: Apache-2.0
"""A motion by steps with error control: any torque, control periods, limits, stiff scenes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sst_ros.host.compiled_module import numba_version
from sst_ros.host.output import Bar
from sst_ros.integration.adaptive_stepper import (
    WHOLE_MOTION_BUDGET,
    CannotStep,
    EvaluationBudget,
    Step,
)
from sst_ros.integration.compiled_method import CompiledMethod, Point, has_step_code, state_distance
from sst_ros.integration.propagator import LimitReached, Propagator
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import Torque, TorqueProfile, torque_at
from sst_ros.state import NANOSECONDS, Array, State, Vector3, clamp

_WORTH_LOADING, _WORTH_COMPILING = 20_000, 100_000
"""Evaluations after which a run goes on with compiled code that is there, and makes it: in plain
Python they take one second and five; to compile the steps of a method takes four."""

_WARN_AFTER, _HOPELESS = WHOLE_MOTION_BUDGET // 100, 3.0
"""Evaluations, a second of work, after which a motion is looked at that will not reach its end by
three times its budget: a warning then, and not a stop after half a minute."""

_MANY, _WORST = 8, 0.07
"""Samples in a step from which on a polynomial costs less than a step for each; the share of the
step at which its error is largest."""


@dataclass(frozen=True)
class Task:
    """What is simulated. Times are in seconds, from that at which the scene begins."""

    scene: Scene
    torque: TorqueProfile
    span: tuple[float, float]  # begin and end
    times: Array  # of the samples, ascending
    method: str  # name, or auto
    tolerance: float  # largest error estimate at the end [rad]
    period: int | None = None  # of control [ns], from time zero; None where torques are not held
    memoryless: bool = False  # whether torques that are held depend on time and state alone
    breaks: Sequence[float] | Array = ()  # further times at which the torques jump, ascending
    max_step: float = math.inf  # longest step
    parameters: tuple[str, ...] = ()  # by which the motion is differentiated


class SteppedMotion:
    """One run of a task by steps whose local error is at most its tolerance.

    Args:
        task: what is simulated.
        y: state at the begin; numbers that it lacks at its end are zero.
        limits: whether the limits of the scene end the motion.
        spent: evaluations of earlier runs of the same motion.
        progress: draw a bar on a terminal.

    Attributes:
        rows: of each sample time, quaternion, body rate, torques, angles and rates of the joints.
        held: times of control [s] and the torques from then on.
        start, at, time: first and last valid point, and time of the last [s].
        status, message: 0 at the end, 1 at a limit, -1 where no step resolves the motion; why.
        propagator: what made the steps.
        budget: `budget.spent` counts evaluations of the derivative.

    """

    def __init__(
        self,
        task: Task,
        y: Sequence[float] | Array,
        *,
        limits: bool = True,
        spent: int = 0,
        progress: bool = False,
    ) -> None:
        self._task, self._spent = task, spent
        self.budget = EvaluationBudget(WHOLE_MOTION_BUDGET, whole_run=True)
        self.propagator = Propagator(
            task.scene, task.method, task.tolerance, compiled=False, budget=self.budget,
            limits=limits, max_step=task.max_step,
        )  # fmt: skip
        self.start = self.at = self.propagator.begin(list(y))
        self.time, self.status, self.message = task.span[0], 0, "reached the end"
        self.held: list[tuple[float, Vector3]] = []
        self.rows: list[tuple[float, ...]] = []
        self._wanted: list[float] = task.times[::-1].tolist()
        self._torque: Torque = (0.0, 0.0, 0.0)
        self._other: Vector3 | None = None  # on the second solution, where they differ
        self._segment = task.span
        self._bar = Bar(f"{task.scene.name}, simulating", progress)
        self._compile_after = _WORTH_LOADING if numba_version() else math.inf
        self._warn_after: float = _WARN_AFTER

    def run(self) -> SteppedMotion:
        """Go to the end or a limit: through segments of a smooth torque, by steps, to events."""
        moment = (0.0, 0.0, 0.0) if self.propagator.dynamics.has_moment_topic else ()
        try:
            for begin, h, end, torque in self._segments():
                self._segment = begin, end
                self._torque = self.propagator.torque.acting(torque)
                self._take_if_wanted(begin, self.at.y)
                with np.errstate(all="ignore"):
                    for step in self.propagator.steps(
                        self.at, begin, h, self._torque, moment, self._other
                    ):
                        self._pass(step)
        except LimitReached as reached:
            self.status, stop = 1, reached.limit.reason
            self._take(math.floor(reached.time * NANOSECONDS) / NANOSECONDS, None)
            self.time = reached.time
        except (CannotStep, ArithmeticError, ValueError) as error:
            self.status, stop = -1, str(error) or "not finite"
            self._take(self.time, self.at.y)
        if self.status:
            self.message = f"stopped at t = {self.time:.12f} s: {stop}"
        return self

    def state(self) -> State:
        """Return the last valid state."""
        return self._state_of(self.at, self._torque)

    def _state_of(self, at: Point, torque: Torque) -> State:
        acting = self.propagator.acting(torque, self.time, at)
        return State.of(round(self.time * NANOSECONDS), at.y, at.joints, acting)

    def _segments(self) -> Iterator[tuple[float, float, float, Torque]]:
        """Yield begin, length and end of segments [s], and the torque, smooth in each."""
        task, (begin, end) = self._task, self._task.span
        if task.period is not None:
            last = round(end * NANOSECONDS)
            for start in range(0, last, task.period):
                time = start / NANOSECONDS
                self._take_if_wanted(time, self.at.y)
                state = (self.state(),) if task.torque.feedback else ()
                held = torque_at(task.torque, time, *state)
                self.held.append((time, held))
                if task.torque.feedback and task.memoryless:
                    self._other = self._answer_second(time)
                stop = min(start + task.period, last)
                yield time, (stop - start) / NANOSECONDS, stop / NANOSECONDS, held
            return
        kinks = np.union1d(task.breaks, task.torque.kinks(task.scene.torque_limit, end))
        inside = kinks[(kinks > begin) & (kinks < end)].tolist()
        for start, stop in pairwise([begin, *inside, end]):
            acting = task.torque.acting(start, stop)
            yield start, stop - start, stop, acting

    def _answer_second(self, time: float) -> Vector3:
        """Return what a function without memory gives to the second solution [N m]."""
        at = self.propagator.begin(self.at.z)
        before = self._torque if self._other is None else self._other
        found = torque_at(self._task.torque, time, self._state_of(at, before))
        return clamp(found, self.propagator.torque.limit)

    def _pass(self, step: Step) -> None:
        """Take samples in an accepted step."""
        if self._spent + self.budget.spent > self._compile_after:
            self._compile(step.machine)
        self._last, self._last_begin = step, self._segment[0] + step.t
        end = self._segment[1] if step.last else self._last_begin + step.h
        inside = []
        while self._wanted and self._wanted[-1] < end:
            inside.append(self._wanted.pop())
        polynomial = self._interpolate(step) if len(inside) >= _MANY else None
        for time in inside:
            y = None if polynomial is None else polynomial(time - self._last_begin)
            self._take(time, y)
        self.time, self.at = end, step.end
        self._take_if_wanted(end, step.end.y)
        begin, last = self._task.span
        share = (end - begin) / (last - begin)
        self._bar.draw(share)
        if self.budget.spent > self._warn_after:
            self._warn_after = math.inf
            if _HOPELESS * WHOLE_MOTION_BUDGET * share < self.budget.spent:
                done = f"{self.budget.spent:,} evaluations for {100.0 * share:.2g} % of the motion"
                most = f"it stops at {WHOLE_MOTION_BUDGET:,}: shorten it, or change its method"
                text = f"{self._task.scene.name}: {done}; {most}"
                warnings.warn(text, RuntimeWarning, stacklevel=2)

    def _compile(self, machine: CompiledMethod) -> None:
        """Take compiled steps from now on, if their code is there or the run is long.

        Under a function only the derivative is compiled, which takes a second.
        """
        there = callable(self._torque) or has_step_code(machine.system, machine.method)
        if there or self._spent + self.budget.spent > _WORTH_COMPILING:
            self.propagator.compile()
            self._compile_after = math.inf
        else:
            self._compile_after = _WORTH_COMPILING

    def _interpolate(self, step: Step) -> Callable[[float], Array] | None:
        """Return a polynomial of the time in a step, through states and slopes at its quarters.

        None where it misses the state by more than the tolerance, where its error is largest.
        """
        from scipy.interpolate import KroghInterpolator  # many runs have few samples

        times = [0.25 * k * step.h for k in range(5)]
        states = [step.begin.y, *(step.inside(x).y for x in times[1:-1]), step.end.y]
        slopes = [
            step.machine.slope(step.t + x, y, step.drive)
            for x, y in zip(times, states, strict=True)
        ]
        data = [row for pair in zip(states, slopes, strict=True) for row in pair]
        polynomial = KroghInterpolator(np.repeat(times, 2), data)
        worst = _WORST * step.h
        found, exact = polynomial(worst).tolist(), step.inside(worst).y
        self.budget.charge(4 * step.machine.cost + len(times))
        return polynomial if state_distance(found, exact) <= self._task.tolerance else None

    def _take_if_wanted(self, time: float, y: Sequence[float]) -> None:
        if self._wanted and self._wanted[-1] == time:
            self._take(self._wanted.pop(), y)

    def _take(self, time: float, y: Sequence[float] | Array | None) -> None:
        """Take a sample at a time; a state that is not given is stepped to."""
        if self.rows and self.rows[-1][0] >= time:
            return
        if y is None:
            x = time - self._last_begin
            self.budget.charge(self._last.machine.cost)
            y = (self._last.inside(x) if x > 0.0 else self._last.begin).y
        at = self.propagator.begin(list(y))
        acting = self.propagator.acting(self._torque, time, at)
        self.rows.append((time, *at.y[:7], *acting, *at.joints))
