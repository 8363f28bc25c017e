# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through periods: steps, limits, contact at elastic stops.

The ticks of a recorded run are propagated again by `TickPropagator`, all in one call.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.model import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, ode_under, ode_with_work
from sst_ros.host.compiled_module import numba_version
from sst_ros.integration import step_loops
from sst_ros.integration.adaptive_stepper import (
    AdaptiveStepper,
    CannotStep,
    EvaluationBudget,
    Point,
    Step,
)
from sst_ros.integration.applied_torque import AppliedTorque, Torque
from sst_ros.integration.compiled_method import compile_derivative
from sst_ros.integration.events import (
    contact_events_of,
    first_event,
    free_range,
    just_beyond,
    load_root_finder,
    may_occur,
)
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, Vector3


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
        self.ode = ode_with_work(self.dynamics)
        self.budget = budget
        ends = tuple(limits_of(scene, geometry)) if limits else ()
        contacts = tuple(contact_events_of(scene, geometry))
        self._events = (*ends, *contacts)
        self._ranges = ranges_of([*ends, *free_range(contacts)])
        self.torque = AppliedTorque(self.ode, scene.torque_limit, derivative)
        self._new_stepper = partial(
            AdaptiveStepper, method=integrator, tolerance=tolerance, compiled=compiled,
            ranges=self._ranges, joints=self.dynamics.joints, budget=budget, max_step=max_step,
        )  # fmt: skip
        self._constant = self._new_stepper(self.ode, derivative=derivative)
        self._others: dict[SineTorque | None, AdaptiveStepper] = {}

    def begin(self, y: list[float]) -> Point:
        """Complete quaternion, body rate and lagged torques, zero by default, to a state."""
        return self._constant.begin(y)

    def advance(
        self,
        at: Point,
        start: float,
        h: float,
        count: int,
        torque: Torque,
        moment: tuple[float, ...],
    ) -> tuple[Point, int]:
        """Advance by `count` periods of h [s] from `start` [s], or by fewer, but by one at least.

        The torque is one of `AppliedTorque.acting`.

        Periods that take one step each are one call; another period is done by itself.

        Returns:
            Where the last period ended that was done, and how many were.

        Raises:
            LimitReached, CannotStep, ArithmeticError, ValueError: the first period is not done.

        """
        stepper, drive = self._begin_period(torque, start, moment)
        if stepper is self._constant:
            done, end = stepper.step_many(h, count, at, drive)
            if done:
                return end, done
        with np.errstate(all="ignore"):
            for step in self._steps(stepper, at, start, h, drive):
                at = step.end
        return at, 1

    def steps(
        self, at: Point, start: float, h: float, torque: Torque, moment: tuple[float, ...]
    ) -> Iterator[Step]:
        """Yield the steps of a period: of their own lengths, up to events.

        Raises:
            LimitReached, CannotStep, ArithmeticError, ValueError: as `advance`, after the last
                valid step.

        """
        stepper, drive = self._begin_period(torque, start, moment)
        return self._steps(stepper, at, start, h, drive)

    def _begin_period(
        self, torque: Torque, start: float, moment: tuple[float, ...]
    ) -> tuple[AdaptiveStepper, tuple[float, ...]]:
        """Return the stepper of constant torques, of functions, or of a sine, and the drive."""
        if type(torque) is tuple:
            return self._constant, (*torque, *moment) if moment else torque
        sine = torque if isinstance(torque, SineTorque) else None
        if sine not in self._others:
            if sine is None:
                new = self._new_stepper(self.ode, compiled=False, ranges=(), law=self.torque)
            else:
                new = self._new_stepper(ode_under(self.dynamics, sine, self.torque.limit_of(sine)))
            self._others[sine] = new
        return self._others[sine], (*self.torque.begin(torque, start), *moment)

    def _steps(
        self,
        stepper: AdaptiveStepper,
        at: Point,
        start: float,
        h: float,
        drive: tuple[float, ...],
    ) -> Iterator[Step]:
        """Step through a period; steps end where contact with a stop begins or ends."""
        self.budget.begin()
        x = 0.0
        while x < h:
            event = None
            for step in stepper.accepted_steps(x, h, at, drive, start):
                event, ends = None, (step.begin.joints, step.end.joints)
                if not step_loops.all_far(self._ranges, *ends, step.h):  # type: ignore[no-untyped-call]
                    try:
                        step, event = self._until_first(stepper, step)
                    except CannotStep:
                        raise
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
        load_root_finder()
        self._constant.load()

    def compile(self) -> None:
        """Take compiled steps from now on; the bits are the same."""
        self._new_stepper.keywords["compiled"] = True
        if None in self._others and self.torque.is_traced:
            self.torque.evaluate_by(compile_derivative(self.ode))
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
            return self.dynamics.joints(*step.state(x)[:7])

        ends = step.begin.joints, step.end.joints
        near = [event for event in self._events if may_occur(event, *ends)]
        found = first_event(near, joints, step.h)
        if found is None:
            return step, None
        x, event = found
        if event.error is None:
            x = just_beyond(event, x, joints(x), step.h)
        end = step.begin if x == 0.0 else stepper.part(step, x) if x < step.h else step.end
        return step._replace(h=x, end=end, last=step.last and x == step.h), event


LONGEST_TICK_NS = 1_000_000
"""Longer ticks are divided [ns]."""

_TICK_TOLERANCE, _TICK_BUDGET = 1e-13, 3600
"""Largest local error estimate of a step; evaluations that a tick may take: a hundred steps."""


class TickSequence(NamedTuple):
    """Ticks in order of time."""

    start_ns: NDArray[np.int64]  # relative to the start of the run [ns], shape (m,)
    end_ns: NDArray[np.int64]
    drives: Array  # held over a tick: torques [N m], a moment on the star in {B} [N m] or nothing

    def part(self, ticks: slice) -> TickSequence:
        """Return some of the ticks."""
        return TickSequence(self.start_ns[ticks], self.end_ns[ticks], self.drives[ticks])


class TickPropagator(Propagator):
    """Propagates a scene by DOP853 through ticks, all of one call in compiled code.

    Limits of the scene do not end the motion. Torques over time are within the limit of the
    actuators; without them they are those of each tick.
    """

    def __init__(self, scene: Scene, torque: SineTorque | None, *, compiled: bool) -> None:
        self.compiled = compiled and numba_version() is not None
        budget = EvaluationBudget(_TICK_BUDGET)
        super().__init__(
            scene, DOP853.name, _TICK_TOLERANCE, compiled=self.compiled, budget=budget, limits=False
        )
        self._sine = torque

    def follow(self, ticks: TickSequence, starts: Array) -> Array:
        """Propagate through ticks.

        Args:
            ticks: m ticks.
            starts: states (quaternion, body rate, lagged torques) at which ticks begin, shape
                (m, 7 or 10); NaN where a tick goes on from the one before.

        Returns:
            Solution and second solution at the end of each tick, with the work since the start
            [J], shape (m, 2, 8 or 11); NaN from a tick that no step resolves to the next start.

        """
        length_ns = ticks.end_ns - ticks.start_ns
        parts = np.maximum(1, -(-length_ns // LONGEST_TICK_NS))
        first = np.cumsum(parts) - parts
        length = np.repeat(length_ns / NANOSECONDS / parts, parts)
        begin = np.repeat(ticks.start_ns / NANOSECONDS, parts)
        begin += length * (np.arange(len(length)) - np.repeat(first, parts))
        begins = np.full((len(length), len(self.ode.state)), np.nan)
        begins[first] = np.hstack([starts, 0.0 * starts[:, :1]])
        if self._sine is not None:  # phases of sines, or torques within the limit
            drives = np.fmod(np.outer(begin, self._sine.frequency) + self._sine.phase, 2.0 * np.pi)
        else:
            drives = np.repeat(ticks.drives, parts, axis=0)
            limit = np.inf if self.torque.limit is None else self.torque.limit
            drives[:, :3] = np.clip(drives[:, :3], -limit, limit)
        reached = self._follow_parts(begin, length, drives, begins)
        return np.asarray(reached[first + parts - 1])

    def _follow_parts(self, begin: Array, length: Array, drives: Array, starts: Array) -> Array:
        reached: Any = np.full((len(length), 2, len(self.ode.state)), np.nan)
        given: Any = (length, drives, starts)
        if not self.compiled:
            reached, given = reached.tolist(), tuple(array.tolist() for array in given)
        stepper, _ = self._begin_period(self._sine or (0.0, 0.0, 0.0), 0.0, ())
        at, k = stepper.begin(starts[0, :-1].tolist()), 0
        while k < len(length):
            k, at = stepper.step_sequence(k, given, at, reached)
            if k == len(length):
                break
            held = tuple(drives[k].tolist())
            torque = self._sine or (held[0], held[1], held[2])
            try:
                at, _ = self.advance(at, float(begin[k]), float(length[k]), 1, torque, held[3:])
                reached[k][0][:], reached[k][1][:] = at.y, at.z
                k += 1
            except (LimitReached, CannotStep, ArithmeticError, ValueError):
                later = np.flatnonzero(np.isfinite(starts[k + 1 :, 0]))
                k = k + 1 + int(later[0]) if len(later) else len(length)
        return np.asarray(reached)
