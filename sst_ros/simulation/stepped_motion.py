# SPDX-License-Identifier: Apache-2.0
"""A run of a motion by steps with error control, and its samples."""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sst_ros.integration.function_steps import TimeSteps
from sst_ros.integration.method_steps import MethodSteps
from sst_ros.integration.methods import AUTO, DOP853, Method
from sst_ros.integration.point import Period, Point, Step, state_distance
from sst_ros.integration.stepper import (
    ACCURATE,
    CannotStep,
    EvaluationBudget,
    LimitReached,
    Stepper,
)
from sst_ros.progress import Bar
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import Torque, TorqueProfile
from sst_ros.simulation.samples import Samples
from sst_ros.state import MOMENT, NANOSECONDS, Array, State, Vector3, clamp

_WARN_AFTER = 100_000
"""Evaluations after which a motion warns if its budget will not do.

Where a function gives the torques they take a second, and the budget half a minute.
"""
_HOPELESS = 3.0
"""Multiple of its budget that a motion needs which warns."""


@dataclass(frozen=True)
class Task:
    """What is simulated. Times are in seconds, from that at which the scene begins."""

    scene: Scene
    torque: TorqueProfile
    span: tuple[float, float]  # begin and end
    times: Array  # of the samples, ascending
    method: str  # name, or auto
    tolerance: float  # largest error estimate at the end [rad]
    # of control [ns], from time zero; None where torques are not held
    period: int | None = None
    # whether torques that are held depend on time and state alone
    memoryless: bool = False
    # further times at which the torques jump, ascending
    breaks: Sequence[float] | Array = ()
    max_step: float = math.inf  # longest step
    parameters: tuple[str, ...] = ()  # by which the motion is differentiated

    @property
    def remembers(self) -> bool:
        """Whether its function may have a memory: it is called once a period."""
        return self.period is not None and not self.memoryless


class SteppedMotion:
    """One run of a task by steps whose local error is at most its tolerance.

    Args:
        task: what is simulated.
        y: state at the begin; numbers that it lacks at its end are zero.
        budget: evaluations that it may take, those of earlier runs of the same motion
            included.
        limits: whether the limits of the scene end the motion.
        progress: draw a bar on a terminal.

    Attributes:
        samples: those that were taken.
        held: times of control [s] and the torques from then on.
        answered_error: largest estimated error of the states that a function which may
            have a memory has answered [rad].
        start, point, time: first and last valid point, and time of the last [s].
        status, message: 0 at the end, 1 at a limit, -1 where no step resolves the
            motion; why.
        stepper: what made the steps.

    """

    def __init__(
        self,
        task: Task,
        y: Sequence[float] | Array,
        budget: EvaluationBudget,
        *,
        limits: bool = True,
        progress: bool = False,
    ) -> None:
        self._task = task
        self._budget = budget
        self.stepper = Stepper(
            task.scene, task.method, task.tolerance, budget=budget, limits=limits,
            max_step=task.max_step,
        )  # fmt: skip
        self.start = self.point = self.stepper.begin(list(y), _first_method(task))
        self.time = task.span[0]
        self.status = 0
        self.message = "reached the end"
        self.held: list[tuple[float, Vector3]] = []
        self.answered_error = 0.0
        self.samples = Samples(self.stepper)
        self._times: list[float] = task.times.tolist()
        self._next = 0  # place of the next time
        self._torque: Torque = (0.0, 0.0, 0.0)
        # on the second solution, where they differ
        self._second_torque: Vector3 | None = None
        self._segment = task.span
        self._step: Step | None = None  # the last one
        self._step_begin = task.span[0]  # time at which it begins [s]
        self._moment = (0.0,) * len(self.stepper.dynamics.drive[MOMENT])
        self._bar = Bar(f"{task.scene.name}, simulating", progress)
        self._spent_before = budget.spent
        self._warn_after: float = budget.spent + _WARN_AFTER

    def run(self) -> SteppedMotion:
        """Go to the end or a limit."""
        try:
            with np.errstate(all="ignore"):
                if self._task.period is None:
                    self._follow_profile()
                else:
                    self._hold_periods(self._task.period)
        except LimitReached as reached:
            self.status = 1
            reason = reached.limit.reason
            end = math.floor(reached.time * NANOSECONDS) / NANOSECONDS
            self._take_at_limit(end)
            self.time = reached.time
        except CannotStep as error:
            self.status = -1
            reason = str(error)
            self._take(self.time, self.point.y)
        if self.status:
            self.message = f"stopped at t = {self.time:.12f} s: {reason}"
        return self

    def state(self) -> State:
        """Return the last valid state."""
        return self._state_of(self.point, self._torque)

    def _state_of(self, point: Point, torque: Torque) -> State:
        acting = self.stepper.acting(torque, self.time, point)
        return State.of(round(self.time * NANOSECONDS), point.y, point.joints, acting)

    def _follow_profile(self) -> None:
        """Go through segments in each of which the torque is smooth."""
        task = self._task
        begin, end = task.span
        kinks = task.torque.kinks(task.scene.torque_limit, end)
        if len(task.breaks) or len(kinks):
            kinks = np.union1d(task.breaks, kinks)
        inside = kinks[(kinks > begin) & (kinks < end)].tolist()
        for start, stop in pairwise([begin, *inside, end]):
            self._advance(start, stop - start, stop, task.torque.piece(start, stop))

    def _hold_periods(self, period: int) -> None:
        """Go through control periods [ns], which hold the torques of a function."""
        task = self._task
        end_ns = round(task.span[1] * NANOSECONDS)
        for start_ns in range(0, end_ns, period):
            time = start_ns / NANOSECONDS
            self._take_if_wanted(time, self.point.y)
            if task.torque.feedback:
                torque = task.torque.at(time, self.state())
            else:
                torque = task.torque.at(time)
            self.held.append((time, torque))
            if task.torque.feedback and task.memoryless:
                self._second_torque = self._answer_second(time)
            elif task.torque.feedback:
                self.answered_error = max(self.answered_error, self.point.error)
            stop_ns = min(start_ns + period, end_ns)
            # Not stop less start in seconds: rounding would make periods unequal.
            length = (stop_ns - start_ns) / NANOSECONDS
            self._advance(time, length, stop_ns / NANOSECONDS, torque)

    def _answer_second(self, time: float) -> Vector3:
        """Return what a function without memory gives to the second solution [N m]."""
        point = self.stepper.begin(self.point.z)
        before = self._torque if self._second_torque is None else self._second_torque
        torque = self._task.torque.at(time, self._state_of(point, before))
        return clamp(torque, self.stepper.torque.limit)

    def _advance(self, begin: float, h: float, end: float, torque: Torque) -> None:
        """Go through a segment of length h from `begin` to `end` [s] under a torque."""
        self._segment = begin, end
        self._torque = self.stepper.torque.acting(torque)
        self._take_if_wanted(begin, self.point.y)
        period = Period(begin, h, self._torque, self._moment, self._second_torque)
        self.stepper.advance(self.point, period, visit=self._pass)

    def _pass(self, step: Step) -> None:
        """Take the samples in a step, and note where the motion stands."""
        segment_begin, segment_end = self._segment
        self._step = step
        self._step_begin = segment_begin + step.t
        end = segment_end if step.last else self._step_begin + step.h
        times = self._times
        if self._next < len(times) and times[self._next] < end:
            first = self._next
            self._next = bisect_left(times, end, first)
            self._take_between(times[first : self._next])
        self.time = end
        self.point = step.end
        self._take_if_wanted(end, step.end.y)
        motion_begin, motion_end = self._task.span
        share = (end - motion_begin) / (motion_end - motion_begin)
        self._bar.draw(share)
        if self._budget.spent > self._warn_after:
            self._warn_if_hopeless(share)

    def _take_between(self, times: list[float]) -> None:
        """Take samples at ascending times in the last step [s]."""
        step = self._step
        begin = self._step_begin
        assert step is not None
        if times[0] <= begin:  # the time of its begin, but for rounding
            self._take(times[0], step.begin.y)
            times = times[1:]
        # The samples of compiled steps are computed together, at the end.
        if isinstance(step.steps, (MethodSteps, TimeSteps)):
            self.samples.add_inside(times, self._torque, step, begin)
            return
        x = [time - begin for time in times]
        states = self._interpolate(step, x)
        if states is None:
            states = [self._step_inside(step, after) for after in x]
        for time, y in zip(times, states, strict=True):
            self._take(time, y)

    def _take_at_limit(self, time: float) -> None:
        """Take the last sample, in the last step; the budget need not allow for it."""
        step = self._step
        assert step is not None
        x = time - self._step_begin
        y = step.begin.y
        if x > 0.0:  # not the time of its begin, but for rounding
            self.samples.evaluations += step.steps.cost
            y = step.inside(x)
        self._take(time, y)

    def _warn_if_hopeless(self, share: float) -> None:
        """Warn once if the motion would far exceed its budget, `share` being done."""
        self._warn_after = math.inf
        most = self._budget.per_period
        spent = self._budget.spent - self._spent_before
        if _HOPELESS * most * share < spent:
            text = (
                f"{self._task.scene.name}: {spent:,} evaluations for"
                f" {100.0 * share:.2g} % of the motion; it stops at {most:,}: shorten"
                " it, or change its method"
            )
            warnings.warn(text, RuntimeWarning, stacklevel=2)

    def _interpolate(self, step: Step, x: list[float]) -> list[list[float]] | None:
        """Return the states at times x after the begin of a step [s], by a polynomial.

        None where a step for each costs less, and where the polynomial misses a state
        by more than the tolerance: the one where its error is largest.
        """
        steps = step.steps
        cost = steps.interpolation_cost + steps.cost
        if cost > len(x) * steps.cost:
            return None
        self._budget.charge(cost)
        polynomial = steps.interpolate(step)
        if polynomial is None:
            return None
        worst = steps.worst * step.h
        *states, checked = polynomial(np.array([*x, worst])).tolist()
        distance = state_distance(checked, step.inside(worst))
        return states if distance <= self._task.tolerance else None

    def _step_inside(self, step: Step, x: float) -> list[float]:
        """Return the state at x after the begin of a step [s], by a shorter step."""
        self._budget.charge(step.steps.cost)
        return step.inside(x)

    def _take_if_wanted(self, time: float, y: Sequence[float]) -> None:
        """Take a sample at a time and a state if it is the next one."""
        if self._next < len(self._times) and self._times[self._next] == time:
            self._next += 1
            self._take(time, y)

    def _take(self, time: float, y: Sequence[float]) -> None:
        """Take a sample at a time and a state."""
        self.samples.add(time, self._torque, y)


def _first_method(task: Task) -> Method | None:
    """Return the method `auto` begins a long and accurate motion with, or None."""
    accurate = task.period is None and task.tolerance < ACCURATE
    return DOP853 if task.method == AUTO and accurate else None
