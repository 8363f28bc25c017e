# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through periods: torques that act, steps, limits, contacts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np

from sst_ros.dynamics.model import (
    CONTACT_BAND,
    GRAZING,
    Limit,
    contact_events_of,
    free_range,
    limits_of,
    ranges_of,
)
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, recent_ode
from sst_ros.errors import InputError, Problem
from sst_ros.integration import step_loops
from sst_ros.integration.adaptive_stepper import AdaptiveStepper, EvaluationBudget, Step
from sst_ros.integration.compiled_method import Point, TorqueLaw, compile_derivative
from sst_ros.mechanism.geometry import Geometry
from sst_ros.programs.expression import compile_program
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import SineTorque, Torque, torque_at
from sst_ros.state import NANOSECONDS, State, Vector3, clamp

Moment = tuple[float, ...]
"""External moment on the star in {B} [N m] where the scene takes it from a topic, else empty."""

Signal = Callable[[float], float]

TIME_TOLERANCE = 1e-15
"""Accuracy of a located time [s], above the rounding of the time itself."""
_SEARCHED = 8
"""Parts of a step in which a jump is looked for."""
_TIME_STEP = 1e-7
"""For the derivative of a torque by time [s]: an error of 1e-9 where it changes within 1 ms."""
_STATE_STEP = 1e-7
"""For its derivatives by the state, relative to numbers above 1: half of the digits remain."""


class LimitReached(Exception):
    """A limit of the scene ends the motion at a time [s]."""

    def __init__(self, limit: Limit, time: float) -> None:
        self.limit, self.time = limit, time
        super().__init__(limit.reason)


class Propagator:
    """Advances a scene through periods of constant drive, or of torques that are a function.

    Nothing changes in it as a run goes on but what its budget has spent: the run is its points.

    Args:
        scene: what is simulated.
        integrator: a method of `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step.
        derivative: of the state in plain Python, in place of the traced one and with its inputs;
            for explicit methods, and for torques that are numbers or functions.
        limits: whether the limits of the scene end the motion.

    Attributes:
        dynamics, ode: of the scene.
        torque: clamps torques, and evaluates those that are a function.
        budget: as given; `budget.spent` counts evaluations.

    """

    def __init__(
        self,
        scene: Scene,
        integrator: str,
        tolerance: float,
        *,
        compiled: bool,
        budget: EvaluationBudget,
        derivative: Function | None = None,
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
        self._ranges = ranges_of([*ends, *free_range(contacts)])
        self.torque = acting = AppliedTorque(self.dynamics, scene.torque_limit, derivative)
        linearise = acting.linearise if acting.is_traced else None
        self._law = TorqueLaw(acting.derivative, linearise, acting.jump)
        self._new_stepper = partial(
            AdaptiveStepper, method=integrator, tolerance=tolerance, compiled=compiled,
            ranges=self._ranges, joints=self.dynamics.joints, budget=budget, max_step=max_step,
        )  # fmt: skip
        self._constant = self._new_stepper(self.ode)
        self._others: dict[SineTorque | None, AdaptiveStepper] = {}

    def begin(self, y: list[float]) -> Point:
        """Complete quaternion, body rate and lagged torques, zero by default, to a state."""
        return self._constant.begin(y)

    def advance(
        self, at: Point, start: float, h: float, count: int, torque: Torque, moment: Moment
    ) -> tuple[Point, int]:
        """Advance by `count` periods of h [s] from `start` [s], or by fewer, but by one at least.

        Periods in which nothing happens but steps are one call; another is done by itself. The
        torque is one of `AppliedTorque.acting`. Returns where the last period ended that was done,
        and how many were. Where the first is not done, LimitReached, CannotStep, ArithmeticError or
        ValueError is raised.
        """
        stepper, drive = self._begin_period(torque, start, moment)
        if stepper is self._constant:
            done, end = stepper.step_many(h, count, at, drive)
            if done:
                return end, done
        with np.errstate(all="ignore"):
            for step in self.steps(at, start, h, torque, moment):
                at = step.end
        return at, 1

    def _begin_period(
        self, torque: Torque, start: float, moment: Moment
    ) -> tuple[AdaptiveStepper, tuple[float, ...]]:
        """Return the stepper of constant torques, of plain Python, or of a sine, and the drive."""
        if type(torque) is tuple and self.torque.is_traced:
            return self._constant, (*torque, *moment) if moment else torque
        sine = torque if isinstance(torque, SineTorque) else None
        if sine not in self._others:
            if sine is None:
                new = self._new_stepper(self.ode, compiled=False, ranges=(), law=self._law)
            else:
                limit = self.torque.limit_of(sine)
                ode = recent_ode(self.dynamics, sine, limit=limit, work=True, phases=True)
                new = self._new_stepper(ode)
            self._others[sine] = new
        return self._others[sine], (*self.torque.begin(torque, start), *moment)

    def steps(
        self,
        at: Point,
        start: float,
        h: float,
        torque: Torque,
        moment: Moment,
        other: Vector3 | None = None,
    ) -> Iterator[Step]:
        """Yield the steps of a period: of their own lengths, each up to the first event in it.

        The second solution has the constant torques `other`, by default those of the first. Errors
        are those of `advance`, raised after the last valid step.
        """
        stepper, drive = self._begin_period(torque, start, moment)
        second = None if other is None else (*other, *moment)
        self.budget.begin()
        x = 0.0
        while x < h:
            event = None
            for step in stepper.accepted_steps(x, h, at, drive, start, second):
                event, ends = None, (step.begin.joints, step.end.joints)
                if not step_loops.all_far(self._ranges, *ends, step.h):  # type: ignore[no-untyped-call]
                    try:
                        step, event = self._until_first(stepper, step)
                    except (ArithmeticError, ValueError):  # it has leapt over a singularity
                        x, at = step.t, step.begin._replace(h=0.5 * step.h)
                        break
                yield step
                at = step.end
                if event is not None:
                    x = step.t + step.h
                    break
            else:
                return
            if event is not None and event.error is not None:
                raise LimitReached(event, start + x)

    def load(self) -> None:
        """Have the code loaded that periods under constant torques may need."""
        import scipy.optimize  # noqa: F401  # takes 0.4 s, too long for a step in real time

        if self.torque.is_traced:
            self._constant.load()

    def compile(self) -> None:
        """Take compiled steps from now on; the bits are the same."""
        self._new_stepper.keywords["compiled"] = True
        if None in self._others and self.torque.is_traced:
            self.torque.rhs = compile_derivative(self.ode)
        for stepper in (self._constant, *self._others.values()):
            stepper.compile()

    def acting(self, torque: Torque, time: float, at: Point) -> Vector3:
        """Torques that the actuators give at a time [s] and a point [N m]."""
        if len(self.dynamics.state) > 7:  # they lag
            return at.y[7], at.y[8], at.y[9]
        return self.torque.at(torque, time, at.y)

    def _until_first(self, stepper: AdaptiveStepper, step: Step) -> tuple[Step, Limit | None]:
        """Return an accepted step up to the first event in it, and that, or all of it."""

        @cache
        def joints(x: float) -> tuple[float, ...]:
            if x in (0.0, step.h):
                return step.end.joints if x else step.begin.joints
            self.budget.charge(step.machine.cost)
            return step.inside(x).joints

        ends = step.begin.joints, step.end.joints
        near = [event for event in self._events if may_occur(event, *ends)]
        found = first_event(near, joints, step.h)
        if found is None:
            return step, None
        x, event = found
        if event.error is None:  # just beyond the kink, where the Jacobian is that of its far side
            beyond = x + 1e-14 / max(abs(event.slope(joints(x))), 1e-200)
            x = min(beyond, x + 1e-3 * step.h, step.h)
        end = step.begin if x == 0.0 else stepper.part(step, x) if x < step.h else step.end
        return step._replace(h=x, end=end, last=step.last and x == step.h), event


class AppliedTorque:
    """Derivative of the state under a torque function, and the clamp of the actuators.

    Args:
        dynamics: its equations with work have the torques in their drive.
        limit: largest torque of an actuator [N m], or None.
        derivative: of the state in place of that of these equations, with their inputs;
            `is_traced` says that there is none.

    """

    def __init__(
        self, dynamics: Dynamics, limit: float | None, derivative: Function | None
    ) -> None:
        self._dynamics, self._ode, self.limit = dynamics, recent_ode(dynamics, work=True), limit
        self.is_traced = derivative is None
        if derivative is not None:
            self.rhs = derivative
        self._torque: Torque = (0.0, 0.0, 0.0)
        self._start = 0.0

    @cached_property
    def rhs(self) -> Function:
        """The derivative under torques that are numbers; machine code may take its place."""
        return compile_program(self._ode.program)

    def acting(self, torque: Torque) -> Torque:
        """Return what acts: numbers within the limit of the actuators; functions as they are.

        A sine becomes a function where it is no part of the program: the actuators clamp it, or
        the derivative was given.
        """
        if isinstance(torque, SineTorque):
            return torque if self.is_traced and self.limit_of(torque) is None else torque.at
        if callable(torque):
            return torque
        first, second, third = map(float, torque)
        return clamp((first, second, third), self.limit)

    def limit_of(self, torque: SineTorque) -> float | None:
        """Return the limit of the actuators where it clamps a sine [N m]."""
        limit = self.limit
        return None if limit is None or max(map(abs, torque.amplitude)) <= limit else limit

    def begin(self, torque: Torque, start: float) -> Vector3:
        """Take what acts in a period that begins at `start` [s].

        Returns three numbers of the drive: phases of a sine [rad], else zero.
        """
        if isinstance(torque, SineTorque):
            rows = zip(torque.frequency, torque.phase, strict=True)
            first, second, third = (math.fmod(f * start + p, math.tau) for f, p in rows)
            return first, second, third
        self._torque, self._start = torque, start
        return (0.0, 0.0, 0.0)

    def at(self, torque: Torque, time: float, y: Sequence[float]) -> Vector3:
        """Torques that act at a time [s] and a state y, within the limit [N m].

        In the state that a function is given are the lagged torques of the actuators; without lag
        zero, for torques of this instant are what it returns. ArithmeticError: the state is not
        finite, as in a trial step that is too long.
        """
        given: tuple[Any, ...] = (time,)
        if _has_feedback(torque):
            if not math.isfinite(sum(y)):
                raise ArithmeticError("the state of a trial step is not finite")
            lagged = (y[7], y[8], y[9]) if len(self._dynamics.state) > 7 else (0.0, 0.0, 0.0)
            joints = self._dynamics.joints(*y[:7])
            given = time, State.of(round(time * NANOSECONDS), y, joints, lagged)
        found = torque_at(torque, *given)
        try:
            first, second, third = found
            if isinstance(first + second + third, np.complexfloating):
                raise TypeError
            first, second, third = float(first), float(second), float(third)
        except (TypeError, ValueError):  # a ValueError would count as a motion that diverges
            allowed = "a torque function must return three torques [N m]"
            raise InputError("torque", [Problem(f"f({time:g})", found, allowed)]) from None
        return clamp((first, second, third), self.limit)

    def derivative(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state by time; inputs are its numbers, then those of the drive."""
        size = len(self._ode.state)
        torque = self.at(self._torque, self._start + t, inputs[:size])
        return self.rhs(t, *inputs[:size], *torque, *inputs[size + 3 :])

    def jump(self, begin: float, end: float, y: Sequence[float]) -> tuple[float, float] | None:
        """Locate a jump of a function's torques: the last time before it and the first one after.

        Bisection keeps the half with the larger change: that of a jump stays, any other shrinks
        (Gear & Osterby, ACM Trans. Math. Softw. 10 (1984) 23-44, locate them for the same purpose).

        Between two times of the derivative [s], at the same state y.
        """
        torque = self._torque

        def acting(time: float) -> Vector3:
            return self.at(torque, self._start + time, y)

        times = np.linspace(begin, end, _SEARCHED + 1).tolist()
        found = [acting(time) for time in times]
        changes = [math.dist(a, b) for a, b in pairwise(found)]
        most = max(changes)
        k = changes.index(most)
        (low, high), (before, after) = times[k : k + 2], found[k : k + 2]
        while low < (middle := 0.5 * (low + high)) < high:
            here = acting(middle)
            if math.dist(before, here) >= math.dist(here, after):
                high, after = middle, here
            else:
                low, before = middle, here
            if not math.dist(before, after) > 0.5 * most:
                return None
        return low, high

    def linearise(
        self, t: float, y: Sequence[float], d: Sequence[float], _: Any, slope: Any, by_time: Any,
        matrix: Any,
    ) -> None:  # fmt: skip
        """Fill in derivative, df/dt and df/dy: exact by the state, by differences of the torque.

        See `CompiledMethod` for the arguments.
        """
        torque, size = self._torque, len(self._ode.state)
        assert torque is not None
        time = self._start + t
        now = self.at(torque, time, y)
        found = self._ode.linearised_by_torque(t, *y, *now, *d[3:])
        slope[:] = found[:size]
        rows = np.array(found[2 * size :]).reshape(size + 3, size).T
        by_state, by_torque = rows[:, :size], rows[:, size:]
        # Forward: a step may begin at a kink, behind which the torque has another rate.
        near, far = (np.array(self.at(torque, time + k * _TIME_STEP, y)) for k in (1, 2))
        rate = (4.0 * near - far - 3.0 * np.array(now)) / (2.0 * _TIME_STEP)
        by_time[:] = (np.array(found[size : 2 * size]) + by_torque @ rate).tolist()
        if _has_feedback(torque):
            turns = np.zeros((3, size))
            for i in range(size - 1):  # the last number is the work, which no torque sees
                step = _STATE_STEP * max(1.0, abs(y[i]))
                moved = [*y[:i], y[i] + step, *y[i + 1 :]]
                turns[:, i] = (np.array(self.at(torque, time, moved)) - now) / step
            by_state = by_state + by_torque @ turns
        for i, row in enumerate(by_state.tolist()):
            matrix[i][:] = row


def _has_feedback(torque: Torque) -> bool:
    return bool(getattr(torque, "feedback", False))


# Events inside a step: when a joint reaches a limit, or meets or leaves an elastic stop. The force
# of a stop has a kink where contact begins and ends, so steps end there.


def may_occur(event: Limit, begin: Sequence[float], end: Sequence[float]) -> bool:
    """Test cheaply whether an event may lie in a step, given the joints at both ends.

    A limit counts where the step starts on it; a contact that the step starts on does not.
    """
    before = event.distance(begin)
    if event.error is not None:
        if before <= 0.0:
            return True
    elif before <= GRAZING and not (before > -CONTACT_BAND and event.slope(begin) > 0.0):
        return False
    return event.distance(end) < 0.0 or event.slope(begin) < 0.0 < event.slope(end)


def first_crossing(distance: Signal, slope: Signal, h: float) -> float | None:
    """Time x in [0, h] at which `distance` becomes negative, or None.

    Both signals are smooth functions of the time since the step began and `slope` is the rate of
    `distance`. A dip below zero and back inside the step is found where the slope changes sign
    once. A distance that starts at zero counts if it shrinks, and not if it grows.
    """
    begin, end = 0.0, h
    rising, falling = slope(0.0) > 0.0, slope(h) < 0.0
    if distance(0.0) <= GRAZING:
        if not rising:
            leaves = slope(0.0) < 0.0 or distance(h) < -GRAZING  # from rest, the latter
            return 0.0 if distance(0.0) < -GRAZING or leaves else None
        if distance(h) >= 0.0 or (distance(h) >= -GRAZING and not falling):
            return None
        # It grew first: the crossing lies behind the maximum.
        begin = _root(slope, 0.0, h) if falling else 0.0
    elif distance(h) >= 0.0:
        if rising or falling:
            return None
        end = _root(slope, 0.0, h)
        if distance(end) >= 0.0:
            return None
    return _root(distance, begin, end)


def first_event(
    limits: Iterable[Limit], joints: Callable[[float], Sequence[float]], h: float
) -> tuple[float, Limit] | None:
    """Return time in [0, h] and limit of the first event; `joints` are those at a time."""
    found = []
    for limit in limits:
        x = first_crossing(
            lambda x, at=limit: at.distance(joints(x)),  # type: ignore[misc]
            lambda x, at=limit: at.slope(joints(x)),  # type: ignore[misc]
            h,
        )
        if x is not None:
            found.append((x, limit))
    return min(found, key=lambda pair: pair[0]) if found else None


def _root(signal: Signal, begin: float, end: float) -> float:
    if signal(begin) == 0.0 or signal(begin) * signal(end) > 0.0:
        return begin
    from scipy.optimize import brentq  # takes 0.4 s, and many runs have no event

    return float(brentq(signal, begin, end, xtol=TIME_TOLERANCE, rtol=1e-15))
