# SPDX-License-Identifier: Apache-2.0
"""The loop that advances a scene: periods, steps, their length and method, and events.

1. A period has torques that are numbers, a sine, or a function; it is a tick of a node,
   a period of a controller, or a whole motion.
2. Its steps are as long as the error estimate of the last one allows; one whose error
   exceeds the tolerance is taken again, shorter. Where a function jumps, a step ends.
3. `auto` looks at the eigenvalues of the Jacobian now and then, and takes the method
   whose steps would be longer.
4. A step that may pass a limit, or meet or leave an elastic stop, ends at the first of
   them.
5. A step does not leap over the rates within which Coulomb friction changes its sign.
6. A limit ends the motion by LimitReached. Where no step resolves the motion,
   CannotStep ends it.
7. Equal periods that take one step each, in which nothing happens, are done several in
   one call: `advance_evenly`, with the bits of `advance`.

What a step computes is in `steps.py`; what it starts from and ends with is a `Point`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.model import (
    Limit,
    contact_events_of,
    free_range,
    limits_of,
    ranges_of,
    transitions_of,
)
from sst_ros.dynamics.traced_dynamics import STATE_SIZE, Dynamics, recent_ode
from sst_ros.integration.applied_torque import AppliedTorque, Pulse
from sst_ros.integration.events import (
    first_event,
    largest_overshoot,
    largest_passed,
    may_occur,
    share_before_leap,
)
from sst_ros.integration.function_steps import (
    FeedbackSteps,
    FunctionSteps,
    TimeSteps,
)
from sst_ros.integration.method_steps import (
    JACOBIAN_COST,
    PERIODS_AT_ONCE,
    SAFETY,
    MethodSteps,
    step_factor,
    steps_of,
)
from sst_ros.integration.methods import (
    AUTO,
    DOP853,
    DORMAND_PRINCE,
    METHODS,
    RODAS5P,
    Method,
    Rosenbrock,
)
from sst_ros.integration.point import (
    PAIR_STEPS,
    Drive,
    Drives,
    MethodChange,
    Outcome,
    Period,
    Point,
    Step,
)
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import ConstantTorque, SineTorque, Torque
from sst_ros.state import LAGGED_TORQUES, MOMENT, STAR, ZERO, Vector3

Steps = MethodSteps | FunctionSteps

WHOLE_MOTION_BUDGET = 10_000_000
"""Evaluations where a period may be a whole motion, offline.

They take minutes in plain Python.
"""

_LAST_SLIVER = 1e-3
"""A step also takes the rest of a period that is shorter than this share of it."""
_SHORTEST_STEP = 1e-15
"""Relative to the time: below it, the rounding of time is as long as a step."""
_SHORTEST_IN_TRANSITION = 1e-9
"""Relative to the time: friction that changes within less is one that jumps, and a step
is not made shorter for it."""
_SHORTEST_SEARCH = 1e-13
"""Relative to the time: in a shorter step a jump would lie within rounding."""
_UNWATCHED = 1e-3
"""Length [s] up to which a step is not searched for pulses, as a tick of a simulation.

No more than 0.3 ms lie between its stages.
"""
_NEAR_THE_ENDS = 1e-12
"""Share of a step within which a kink at one of its ends changes nothing."""
_MOST_LOOKS = 60
"""Times that a step is made shorter for a pulse: by halves down to rounding."""
_JUMP_MARGIN = 4e-16
"""Relative to the time: distance of steps from a jump, before it and after it."""
_BEHIND_A_KINK = 1e-14
"""Angle [rad] by which a step goes beyond a kink, to the Jacobian of its far side."""
_LARGEST_SHARE_BEHIND = 1e-3
"""...but by no more than this share of the step, where the joint hardly moves."""
_NEARLY_ZERO = 1e-200
"""Least length of a step [s], and least rate that is divided by."""

_CHOOSE_EVERY = 16
"""Attempted steps after which `auto` looks at the method."""
_CHOOSE_AFTER_REJECTIONS = 3
"""Rejections in a row after which it does so, too.

A Coulomb torque that changes sign sharply would otherwise shrink explicit steps below
its time constant before it is seen.
"""
_STIFF = 2.0
"""Step times fastest decay above which an explicit method is left.

It is stable to about 3.
"""
_DECAYING = 0.5
"""Share of the fastest rate that the fastest decay has at least in a stiff motion: a
fast oscillation has to be resolved, and an implicit method would gain nothing.
"""
_EASY = 0.5
"""Step times fastest rate below which an implicit method is left."""
ACCURATE = 1e-7
"""Tolerance below which order 8 takes fewer evaluations than order 5."""


class LimitReached(Exception):
    """A limit of the scene ends the motion at a time [s]."""

    def __init__(self, limit: Limit, time: float) -> None:
        self.limit = limit
        self.time = time
        super().__init__(limit.reason)


class CannotStep(Exception):
    """No step is small enough to resolve the motion."""


class BudgetSpent(CannotStep):
    """The evaluations that a period may take are used up."""


class _NoState(Exception):
    """A state inside an accepted step is not finite."""


class EvaluationBudget:
    """Evaluations of the right-hand side that a period, or a whole run, may take.

    `spent` counts those of a run.
    """

    def __init__(self, per_period: int, *, whole_run: bool = False) -> None:
        self.per_period = per_period
        self._whole_run = whole_run
        self.spent = 0
        self._limit = per_period  # of `spent`, in this period

    def begin(self) -> None:
        """Begin a period."""
        if not self._whole_run:
            self._limit = self.spent + self.per_period

    def charge(self, evaluations: int) -> None:
        """Count evaluations before they are made.

        Raises:
            BudgetSpent: the period does not have so many left.

        """
        if self.spent + evaluations > self._limit:
            span = "motion" if self._whole_run else "step"
            raise BudgetSpent(
                f"{self.per_period} evaluations do not reach the end of the {span}"
            )
        self.spent += evaluations


class Stepper:
    """Advances a scene through periods.

    As a run goes on, only its budget changes: where the run is, its points say.

    Args:
        scene: what is simulated.
        method: a method of `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step: of the quaternion, and of the
            rate relative to its length.
        budget: counts evaluations, and ends a period that takes too many.
        derivative: of the state in plain Python, in place of the traced one and with
            its inputs; for explicit methods.
        limits: whether the limits of the scene end the motion.
        max_step: longest step [s].

    Attributes:
        dynamics, ode: of the scene.
        torque: clamps torques, and evaluates those that are a function.
        budget: as given; `budget.spent` counts evaluations.

    """

    _traces_clamped_sines = False  # see `traced_sine`; a subclass may set it

    def __init__(
        self,
        scene: Scene,
        method: str,
        tolerance: float,
        *,
        budget: EvaluationBudget,
        derivative: Callable[..., Sequence[float]] | None = None,
        limits: bool = True,
        max_step: float = math.inf,
    ) -> None:
        geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.ode = recent_ode(self.dynamics, work=True)
        self.budget = budget
        ends = tuple(limits_of(scene, geometry)) if limits else ()
        contacts = tuple(contact_events_of(scene, geometry))
        self._events = (*ends, *contacts)
        self._ranges = tuple(ranges_of([*ends, *free_range(contacts)]))
        self._transitions = transitions_of(scene, tolerance)
        self.torque = AppliedTorque(self.dynamics, scene.torque_limit)
        self._derivative = derivative
        self._tolerance = tolerance
        self._max_step = max_step
        self._methods = methods_of(method)
        # A derivative in plain Python has no Jacobian to choose a method by.
        self._chooses = len(self._methods) > 1 and derivative is None
        # by a traced sine, whether a function takes the state, and the method
        self._steps: dict[tuple[SineTorque | None, bool | None, str], Steps] = {}

    def begin(self, y: Sequence[float], method: Method | None = None) -> Point:
        """Return the point at which a run begins.

        Args:
            y: quaternion and body rate, then lagged torques [N m] and work [J], which
                are zero by default.
            method: the first method, by default the first of those that the run may
                use.

        """
        missing = len(self.ode.state) - len(y)
        state = [*y, *[0.0] * missing]
        joints = tuple(self.dynamics.joints(*state[STAR]))
        return Point(state, list(state), joints, method or self._methods[0])

    def load(self) -> None:
        """Have the code compiled that periods under constant torques may need."""
        import scipy.optimize  # noqa: F401  # takes 0.4 s, too long for a step in real time

        no_moment = (0.0,) * len(self.dynamics.drive[MOMENT])
        drive = self._drive_of(Period(0.0, 0.0, ZERO, no_moment))
        methods = self._methods if self._chooses else self._methods[:1]
        for method in methods:
            self._steps_of(drive, method).load()
        if self._chooses:
            _ = self.ode.linearised

    def acting(self, torque: Torque, time: float, point: Point) -> Vector3:
        """Torques that the actuators give at a time [s] and a point [N m]."""
        if len(self.dynamics.state) > STATE_SIZE:  # they lag
            return triple(point.y[LAGGED_TORQUES])
        return self.torque.at(torque, time, point.y)

    def advance(
        self,
        point: Point,
        period: Period,
        visit: Callable[[Step], None] | None = None,
    ) -> Point:
        """Advance through a period, by steps up to the first event in each.

        Args:
            point: where it begins.
            period: its time, and what acts in it.
            visit: called with each step that is done.

        Raises:
            LimitReached: a limit of the scene ends the motion, after the last step.
            CannotStep: steps shrink below the rounding of time.
            BudgetSpent: the period takes more evaluations than it may.

        """
        drives = self._drives_of(period)
        self.budget.begin()
        t = 0.0
        stops: list[float] = []  # times at which steps end: around a jump, or at a kink
        steps = self._steps_of(drives.first, point.method)
        while t < period.h:
            step = self._take_step(t, period.h, point, drives, stops, steps)
            steps = step.steps
            event = None
            if not step.is_far:
                try:
                    step, event = self._until_event(step)
                except _NoState:  # the step has leapt over a singularity
                    point = step.begin._replace(h=0.5 * step.h)
                    stops.clear()
                    continue
            if visit is not None:
                visit(step)
            point = step.end
            if event is not None:
                t += step.h
                stops.clear()
                if event.error is not None:
                    raise LimitReached(event, period.start + t)
            elif step.last:
                break
            elif stops and step.h == stops[0] - t:
                t = stops.pop(0)
            else:
                t += step.h
        return point

    def advance_evenly(
        self, point: Point, period: Period, count: int
    ) -> tuple[Point, int]:
        """Advance through some equal periods in one call, bit for bit as by `advance`.

        That is done for PERIODS_AT_ONCE of them at most, where each is one explicit
        step under constant torques, with nothing to look at inside.

        Args:
            point: where the first begins.
            period: the first.
            count: how many there are.

        Returns:
            Where the last one ends, and how many were done: none where there are too
            few, or the first takes more than that.

        """
        if count < PERIODS_AT_ONCE or self._transitions:
            return point, 0
        if isinstance(point.method, Rosenbrock):
            return point, 0
        drive = self._drive_of(period)
        steps = self._steps_of(drive, point.method)
        if not isinstance(steps, MethodSteps) or drive.sine:
            return point, 0
        h = period.h
        cost = PAIR_STEPS * steps.cost
        is_one_step = self._length_of(point, 0.0, h, ()) == h
        is_far = largest_overshoot(self._ranges, h, point.joints, point.joints) < 0.0
        if not (is_one_step and is_far) or cost > self.budget.per_period:
            return point, 0
        end, errors = steps.periods(h, point, drive, self._tolerance)
        longest = point.h
        for error in errors:
            growth = step_factor(error / self._tolerance, point.method)
            longest = max(longest, h * growth)
            self.budget.begin()
            self.budget.charge(cost)
        return end._replace(h=longest), len(errors)

    def _drives_of(self, period: Period) -> Drives:
        """Return what acts in a period on both solutions."""
        second_drive = None
        if period.second_torque is not None:
            second_drive = Drive((*period.second_torque, *period.moment))
        return Drives(self._drive_of(period), second_drive)

    def _drive_of(self, period: Period) -> Drive:
        """Return what acts in a period on the first solution."""
        torque = period.torque
        moment = period.moment
        start = period.start
        if isinstance(torque, tuple):
            if self._derivative is None:
                return Drive((*torque, *moment), None, start)
            torque = ConstantTorque(torque)
        sine = self.traced_sine(torque)
        if sine is None:
            return Drive((*ZERO, *moment), torque, start)
        phases = []
        for frequency, phase in zip(sine.frequency, sine.phase, strict=True):
            phases.append(math.fmod(frequency * start + phase, math.tau))
        return Drive((*phases, *moment), None, start, sine)

    def traced_sine(self, torque: Torque) -> SineTorque | None:
        """Return a sine that is part of the traced equations, None for other torques.

        A sine that the actuators clamp is not, unless `_traces_clamped_sines`: the
        steps evaluate it, as its kinks divide the motion.
        """
        if not isinstance(torque, SineTorque) or self._derivative is not None:
            return None
        is_clamped = self.torque.limit_of(torque) is not None
        if is_clamped and not self._traces_clamped_sines:
            return None
        return torque

    def _steps_of(self, drive: Drive, method: Method) -> Steps:
        """Return the steps of a method under a drive."""
        function = drive.function
        feedback = None if function is None else function.feedback
        key = drive.sine, feedback, method.name
        if key not in self._steps:
            self._steps[key] = self._make_steps(drive, method)
        return self._steps[key]

    def _make_steps(self, drive: Drive, method: Method) -> Steps:
        """Make the steps of a method under a drive."""
        sine = drive.sine
        function = drive.function
        if sine is not None:
            limit = self.torque.limit_of(sine)
            ode = recent_ode(self.dynamics, sine, limit=limit, work=True, phases=True)
            return steps_of(ode, method, self._ranges)
        if function is None:
            return steps_of(self.ode, method, self._ranges)
        if self._derivative is not None or isinstance(method, Rosenbrock):
            return FunctionSteps(
                self.ode, method, self.torque, self._ranges, self._derivative
            )
        if function.feedback:
            return FeedbackSteps(self.ode, method, self.torque, self._ranges)
        return TimeSteps(self.ode, method, self.torque, self._ranges)

    def _take_step(
        self,
        t: float,
        end: float,
        point: Point,
        drives: Drives,
        stops: list[float],
        steps: Steps,
    ) -> Step:
        """Take one step that is accepted, from t to `end` at most.

        `steps` have taken the last step. `stops` changes where a jump is found: to the
        times just before and after it, at which steps end; or a kink: to its time.
        """
        drive, second = drives
        rejected = 0
        leaps = 0
        looks = 0
        while True:
            if steps.method is not point.method:
                steps = self._steps_of(drive, point.method)
            h = self._length_of(point, t, end, stops)
            self.budget.charge(PAIR_STEPS * steps.cost)
            outcome = steps.pair(t, h, point, drive, second)
            error = outcome.size / self._tolerance
            if outcome.size <= self._tolerance:
                if looks < _MOST_LOOKS and self._meets_pulse(t, h, point, drive, stops):
                    looks += 1
                    shorter = h if stops else 0.5 * h
                    point = point._replace(h=shorter)
                    continue
                ends = point.joints, outcome.joints
                passed = largest_passed(self._transitions, *ends)
                if passed > 1.0:
                    share = share_before_leap(self._transitions, *ends)
                    if leaps:  # the rates are far from linear: a joint that sticks
                        share = min(share, 0.5)
                    if h * share > _SHORTEST_IN_TRANSITION * max(abs(t), end - t):
                        point = point._replace(h=h * share)
                        leaps += 1
                        continue
                last = h == end - t
                ends_before_jump = bool(stops) and h == stops[0] - t
                is_cut = last or ends_before_jump
                longest = plan_length(point, h, error, passed, is_cut=is_cut)
                is_implicit = isinstance(point.method, Rosenbrock)
                counts_attempt = self._chooses and (is_implicit or not last)
                after = end_of(point, outcome, longest, counts_attempt=counts_attempt)
                if counts_attempt:
                    after = self._choose_method(steps, t + h, h, after, drive, 0)
                return Step(
                    t, h, point, after, drive, second, steps, last, outcome.is_far,
                    outcome.stages,
                )  # fmt: skip
            stops[:] = self._stops_in(t, h, point.y, drive)
            if stops:
                point = point._replace(h=h)
                continue
            point = point._replace(h=h * min(step_factor(error, point.method), 1.0))
            if point.h < max(_SHORTEST_STEP * max(abs(t), end - t), _NEARLY_ZERO):
                raise CannotStep(f"steps of {point.h:.1e} s do not resolve it")
            rejected += 1
            if self._chooses:
                point = point._replace(attempts=point.attempts + 1)
                point = self._choose_method(steps, t, h, point, drive, rejected)

    def _length_of(
        self, point: Point, t: float, end: float, stops: Sequence[float]
    ) -> float:
        """Return the length of the next step from t [s], to `end` at most."""
        left = end - t
        h = min(point.h, self._max_step, left)
        if left - h < _LAST_SLIVER * h:
            h = left
        if stops:  # a step ends before a jump, the next one steps over it
            h = min(h, stops[0] - t)
        return h

    def _choose_method(
        self,
        steps: Steps,
        t: float,
        h: float,
        point: Point,
        drive: Drive,
        rejected: int,
    ) -> Point:
        """Change the method if another takes longer steps.

        The eigenvalues of the Jacobian decide. `rejected` counts the attempts in a row
        that were rejected.
        """
        is_explicit = not isinstance(point.method, Rosenbrock)
        is_early = is_explicit and rejected == _CHOOSE_AFTER_REJECTIONS
        if point.attempts < _CHOOSE_EVERY and not is_early:
            return point
        if not is_early:
            point = point._replace(attempts=0)
        self.budget.charge(JACOBIAN_COST)
        try:
            jacobian = steps.jacobian(t, point.y, drive)
        except ArithmeticError:
            return point  # no finite Jacobian here; the step size has to do
        has_its_order = point.method is DOP853 or self._tolerance >= ACCURATE
        if is_explicit and (is_early or has_its_order):  # only stiffness may change it
            moving = jacobian[:-1, :-1]  # nothing depends on the work, the last number
            is_stiff = h * bound_of_eigenvalues(moving) > _STIFF
            if not is_stiff:
                return point
        eigenvalues = np.asarray(np.linalg.eigvals(jacobian), dtype=complex)
        method, reason = better_method(
            point.method, self._tolerance, h * eigenvalues, only_stiff=is_early
        )
        if method is point.method:
            return point
        change = MethodChange(drive.start + t, method.name, reason)
        return point._replace(method=method, changes=(*point.changes, change))

    def _stops_in(
        self, t: float, h: float, y: Sequence[float], drive: Drive
    ) -> list[float]:
        """Return times around a torque's jump in a rejected step, or that of a kink."""
        if drive.function is None:
            return []
        if h < _SHORTEST_SEARCH * max(abs(drive.start + t), h):
            return []
        stops = self._stops_at_jump(t, t + h, y, drive, t, h)
        if stops:
            return stops
        pulse = self._pulse_in(t, h, drive)
        if pulse is None:
            return []
        return self._stops_of(pulse, y, drive, t, h)

    def _stops_at_jump(
        self,
        begin: float,
        end: float,
        y: Sequence[float],
        drive: Drive,
        t: float,
        h: float,
    ) -> list[float]:
        """Return times around a jump between two times in the step from t, if any."""
        jump = self.torque.locate_jump(drive, begin, end, y)
        if jump is None:
            return []
        before, after = jump
        margin = _JUMP_MARGIN * max(abs(drive.start + after), h)
        return [stop for stop in (before - margin, after + margin) if stop > t]

    def _meets_pulse(
        self, t: float, h: float, point: Point, drive: Drive, stops: list[float]
    ) -> bool:
        """Return whether a step must be shortened for a pulse that it passes over.

        That is a pulse of a function of the time, of which its stages may have met
        nothing. Where the pulse begins or ends by a jump, `stops` changes to the times
        around the jump; where there is a kink, to its time.
        """
        pulse = self._pulse_in(t, h, drive)
        if pulse is None:
            return False
        edges = self._stops_of(pulse, point.y, drive, t, h)
        if not edges:
            return pulse.is_large
        if edges == stops:  # steps end at this jump already
            return False
        stops[:] = edges
        return True

    def _pulse_in(self, t: float, h: float, drive: Drive) -> Pulse | None:
        """Return where a function of the time does not follow from its neighbours."""
        if drive.function is None or drive.function.feedback or h <= _UNWATCHED:
            return None
        return self.torque.find_pulse(drive, t, h)

    def _stops_of(
        self, pulse: Pulse, y: Sequence[float], drive: Drive, t: float, h: float
    ) -> list[float]:
        """Return times around a jump in a part of a step, or that of a kink, if any.

        One at an end of the step is none.
        """
        edges = self._stops_at_jump(pulse.begin, pulse.end, y, drive, t, h)
        if edges:
            return edges
        kink = self.torque.locate_kink(drive, pulse.begin, pulse.end)
        if kink is None:
            return []
        margin = max(_NEAR_THE_ENDS * h, _JUMP_MARGIN * abs(drive.start + kink))
        is_inside = t + margin < kink < t + h - margin
        return [kink] if is_inside else []

    def _until_event(self, step: Step) -> tuple[Step, Limit | None]:
        """Return an accepted step up to its first event, and the event.

        The step is returned whole, with None, if it has no event. Raises _NoState where
        a state inside is not finite.
        """
        begin, end = step.begin.joints, step.end.joints
        possible_events = [
            event for event in self._events if may_occur(event, begin, end)
        ]
        if not possible_events:
            return step, None

        @cache
        def joints(x: float) -> Sequence[float]:
            """Return the joints at x [s] after the begin of the step."""
            if x == 0.0:
                return begin
            if x == step.h:
                return end
            self.budget.charge(step.steps.cost)
            state = step.inside(x)
            inside = self.dynamics.joints(*state[STAR])
            if not math.isfinite(sum(state) + sum(inside)):
                raise _NoState
            return inside

        first = first_event(possible_events, joints, step.h)
        if first is None:
            return step, None
        x, event = first
        if event.error is None:
            rate = max(abs(event.slope(joints(x))), _NEARLY_ZERO)
            beyond = min(_BEHIND_A_KINK / rate, _LARGEST_SHARE_BEHIND * step.h)
            x = min(x + beyond, step.h)
        return self._shorten(step, x), event

    def _shorten(self, step: Step, x: float) -> Step:
        """Return the first x [s] of an accepted step, by a shorter one."""
        if x == 0.0:
            return step._replace(h=0.0, end=step.begin, last=False)
        if x == step.h:
            return step
        self.budget.charge(step.cost)
        outcome = step.steps.pair(step.t, x, step.begin, step.drive, step.other)
        end = step.end._replace(y=outcome.y, z=outcome.z, joints=outcome.joints)
        return step._replace(h=x, end=end, last=False, stages=outcome.stages)


def plan_length(
    begin: Point, h: float, error: float, passed: float, *, is_cut: bool
) -> float:
    """Return the longest next step [s] after an accepted one.

    Args:
        begin: where that one began.
        h: its length [s].
        error: its local error relative to the tolerance.
        passed: largest share of a change of friction that it has passed over.
        is_cut: whether it is shorter than the error allows.

    """
    longest = h * step_factor(error, begin.method)
    if is_cut:  # it does not say that the next must be shorter than allowed before
        longest = max(begin.h, longest)
    if passed > 0.0:  # the next step is not to be refused for a leap
        longest = min(longest, SAFETY * h / passed)
    return longest


def end_of(
    begin: Point, outcome: Outcome, longest: float, *, counts_attempt: bool
) -> Point:
    """Return where an accepted step ends.

    Args:
        begin: where it began.
        outcome: what it has given.
        longest: length of the next step at most [s].
        counts_attempt: whether it counts among those after which `auto` looks at the
            method.

    """
    attempts = begin.attempts + 1 if counts_attempt else begin.attempts
    # a call of `_replace` takes three times as long
    return Point(
        outcome.y,
        outcome.z,
        outcome.joints,
        begin.method,
        longest,
        attempts,
        begin.steps + 1,
        begin.changes,
    )


def methods_of(name: str) -> tuple[Method, ...]:
    """Return the methods that a run may use, the one it begins with first.

    `name` is that of a method, or auto.
    """
    if name == AUTO:
        return DORMAND_PRINCE, DOP853, RODAS5P
    return (METHODS[name],)


def better_method(
    method: Method, tolerance: float, rates: NDArray[Any], *, only_stiff: bool
) -> tuple[Method, str]:
    """Choose the method that would take longer steps, and state why.

    It is the one in use where none would. `rates` are the eigenvalues of the Jacobian
    times the length of a step; `only_stiff` looks for stiffness alone.
    """
    radius = np.abs(rates).max()
    decay = -rates.real.min()
    implicit = isinstance(method, Rosenbrock)
    if not implicit and decay > _STIFF and decay > _DECAYING * radius:
        return RODAS5P, f"stiff: step times fastest decay is {decay:.2g}"
    if only_stiff:
        return method, ""
    if implicit and radius < _EASY:
        return DORMAND_PRINCE, f"no longer stiff: step times rate is {radius:.2g}"
    if method is DORMAND_PRINCE and tolerance < ACCURATE and decay <= _STIFF:
        return DOP853, "many small steps that accuracy asks for"
    return method, ""


def bound_of_eigenvalues(matrix: Array) -> float:
    """Return a bound of all magnitudes of eigenvalues, at a fraction of their cost.

    It is the Frobenius norm, the root of the sum of all squares.
    """
    return math.sqrt(np.vdot(matrix, matrix))
