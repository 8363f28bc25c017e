# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through periods: steps, limits, contact at elastic stops."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.limits import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, ode_under, ode_with_work
from sst_ros.integration import step_loops
from sst_ros.integration.adaptive_stepper import (
    AdaptiveStepper,
    EvaluationBudget,
    MethodChange,
    Step,
    StepperCheckpoint,
)
from sst_ros.integration.applied_torque import AppliedTorque, Torque
from sst_ros.integration.compiled_method import Point
from sst_ros.integration.events import (
    contact_events_of,
    first_event,
    free_range,
    just_beyond,
    load_root_finder,
    may_occur,
)
from sst_ros.integration.global_error import ErrorGrowth, coulomb_joints
from sst_ros.integration.methods import RK4
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, SineTorque


class LimitReached(Exception):
    """A limit of the scene ends the motion at a time [s]."""

    def __init__(self, limit: Limit, time: float) -> None:
        self.limit, self.time = limit, time
        super().__init__(limit.reason)


class Checkpoint(NamedTuple):
    """All that a period changes beside the point, and the stepper in use before it."""

    steps: int
    growth: ErrorGrowth
    in_use: AdaptiveStepper
    stepper: AdaptiveStepper
    kept: StepperCheckpoint


class Propagator:
    """Advances a scene through periods of constant drive, or of torques that are a function.

    Args:
        scene: what is simulated.
        integrator: a method of `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step.
        compiled: by numba.
        budget: evaluations that a period may take.
        derivative: derivative of the state in plain Python, in place of the traced one and with
            its inputs; for explicit methods, and for torques that are numbers or functions.
        limits: whether the limits of the scene end the motion.
        max_step: longest step [s].
        observe: called after each accepted step, for motions whose steps are their own: RK4 has
            error control, too, and periods are not done by one call of compiled code.

    Attributes:
        dynamics, ode: of the scene.
        torque: clamps torques, and evaluates those that are a function.
        budget: as given; `budget.spent` counts evaluations.
        accepted_steps: number of accepted steps since the start.

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
        max_step: float = float("inf"),
        observe: Callable[[Step], None] | None = None,
    ) -> None:
        geometry = Geometry.of(scene)
        self.dynamics = Dynamics.of(scene)
        self.ode = ode_with_work(self.dynamics)
        self.budget = budget
        ends = tuple(limits_of(scene, geometry)) if limits else ()
        contacts = tuple(contact_events_of(scene, geometry))
        self._events = (*ends, *contacts)
        self._ranges = ranges_of([*ends, *free_range(contacts)])
        limit = scene.actuators.torque_limit if scene.actuators else None
        self.torque = AppliedTorque(self.ode, limit, derivative)
        self._new_stepper = partial(
            AdaptiveStepper,
            method=integrator,
            tolerance=tolerance,
            compiled=compiled,
            ranges=self._ranges,
            joints=self.dynamics.joints,
            budget=budget,
            max_step=max_step,
            doubling=observe is not None,
        )
        self._observe = observe
        self._constant = self._stepper = self._new_stepper(self.ode, derivative=derivative)
        self._others: dict[SineTorque | None, AdaptiveStepper] = {}
        self._linearise = self.torque.linearise if derivative is None else None
        self.accepted_steps = 0
        self._growth = ErrorGrowth(tuple(coulomb_joints(scene)) if integrator == RK4.name else ())
        self._first = self._before = self._checkpoint(self._constant)

    @property
    def method(self) -> str:
        """Name of the method in use."""
        return self._stepper.method.name

    @property
    def changes(self) -> list[MethodChange]:
        """Changes of method."""
        return self._stepper.history

    def begin(self, y: list[float]) -> Point:
        """Complete quaternion, body rate and lagged torques, zero by default, to a state."""
        full = [*y, *(0.0,) * (len(self.ode.state) - len(y))]
        return Point(full, list(full), self.dynamics.joints(*full[:7]), self._stepper.method.order)

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

        Periods that take one pair of steps each are one call; another period is done by itself.

        Returns:
            Where the last period ended that was done, and how many were.

        Raises:
            LimitReached, CannotStep, ArithmeticError, ValueError: the first period is not done,
                and nothing has changed.

        """
        if type(torque) is tuple:
            stepper, numbers = self._constant, torque
        else:
            stepper, numbers = self._stepper_for(torque), self.torque.begin(torque, start)
        before = self._checkpoint(stepper)
        self._stepper = stepper
        drive = (*numbers, *moment) if moment else numbers
        try:
            done = 0
            if stepper is self._constant and self._observe is None:
                end, done = self._step_many(at, h, count, drive)
            if not done:
                end, done = self._adaptive(at, start, h, drive), 1
        except Exception:
            self._restore(before)
            raise
        self._before = before
        return end, done

    def within(
        self, at: Point, start: float, h: float, torque: Torque, moment: tuple[float, ...]
    ) -> Point:
        """Advance through a part of the last period again, and leave everything as it is now."""
        stepper, before = self._stepper, self._before
        now, history = self._checkpoint(stepper), list(stepper.history)
        self._restore(before)
        try:
            return self.advance(at, start, h, 1, torque, moment)[0]
        finally:
            stepper.history[:] = history
            self._restore(now)
            self._before = before

    def reset(self) -> None:
        """Forget what has happened."""
        self._restore(self._first)
        self._others.clear()
        self._before = self._first

    def load(self, at: Point, h: float, moment: tuple[float, ...]) -> None:
        """Have the code loaded that periods of h [s] under constant torques may need."""
        load_root_finder()
        self._constant.load(h, at, (0.0, 0.0, 0.0, *moment))

    def compile(self) -> None:
        """Take compiled steps from now on; the bits are the same."""
        self._new_stepper.keywords["compiled"] = True
        for stepper in (self._constant, *self._others.values()):
            stepper.compile()

    def errors(self, at: Point) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s]."""
        return self._growth.errors(at, self.accepted_steps)

    def _checkpoint(self, stepper: AdaptiveStepper) -> Checkpoint:
        """Return what to go back to after a period by this stepper."""
        kept = stepper.checkpoint()
        return Checkpoint(self.accepted_steps, self._growth, self._stepper, stepper, kept)

    def _restore(self, checkpoint: Checkpoint) -> None:
        self.accepted_steps, self._growth, self._stepper, stepper, kept = checkpoint
        stepper.restore(kept)

    def _stepper_for(self, torque: Torque) -> AdaptiveStepper:
        """Return the stepper of constant torques, of functions, or of a sine, which is traced."""
        if type(torque) is tuple:
            return self._constant
        sine = torque if isinstance(torque, SineTorque) else None
        if sine not in self._others:
            if sine is None:
                new = self._new_stepper(
                    self.ode, compiled=False, ranges=(),
                    derivative=self.torque.derivative, linearise=self._linearise,
                    find_jump=self.torque.jump,
                )  # fmt: skip
            else:
                new = self._new_stepper(ode_under(self.dynamics, sine, self.torque.limit_of(sine)))
            self._others[sine] = new
        return self._others[sine]

    def _step_many(
        self, at: Point, h: float, count: int, drive: tuple[float, ...]
    ) -> tuple[Point, int]:
        """Advance by up to `count` periods of h [s] that take one pair of steps each."""
        stepper, coulomb = self._stepper, self._growth.coulomb
        if coulomb:  # the joints are looked at after each period
            count = 1
        done, end = stepper.step_many(h, count, at, drive)
        self.accepted_steps += done
        if coulomb and done:
            self._growth = self._growth.after(at, end)
        return end, done

    def _adaptive(self, at: Point, start: float, h: float, drive: tuple[float, ...]) -> Point:
        """Advance by h [s]; steps end where contact with a stop begins or ends."""
        self.budget.begin()
        self._stepper.origin = start
        x = 0.0
        with np.errstate(all="ignore"):
            while x < h:
                at, x, event = self._until_event(at, x, h, drive)
                if event is not None and event.error is not None:
                    raise LimitReached(event, start + x)
        return at

    def _until_event(
        self, at: Point, x: float, h: float, drive: tuple[float, ...]
    ) -> tuple[Point, float, Limit | None]:
        """Go on from x to h, or to the first limit or contact event before."""
        for step in self._stepper.accepted_steps(x, h, at, drive):
            self.accepted_steps += 1
            self._growth = self._growth.after(step.begin, step.end)
            event = None
            if not step_loops.all_far(self._ranges, step.begin.joints, step.end.joints, step.h):  # type: ignore[no-untyped-call]
                step, event = self._until_first(step)
            if self._observe is not None:
                self._observe(step)
            if event is not None:
                return step.end, step.t + step.h, event
            at = step.end
        return at, h, None

    def _until_first(self, step: Step) -> tuple[Step, Limit | None]:
        """Return an accepted step up to the first event in it, and that, or all of it."""

        @cache
        def part(x: float) -> Point:
            return step.end if x == step.h else self._stepper.part(step, x)

        ends = step.begin.joints, step.end.joints
        near = [event for event in self._events if may_occur(event, *ends)]
        found = first_event(near, lambda x: part(x).joints, step.h)
        if found is None:
            return step, None
        x, event = found
        if event.error is None:
            x = just_beyond(event, x, part(x).joints, step.h)
        return step._replace(h=x, end=part(x), last=False), event
