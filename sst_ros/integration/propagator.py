# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through periods: steps, limits, contact at elastic stops."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache, partial

import numpy as np

from sst_ros.dynamics.model import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, ode_under, ode_with_work
from sst_ros.integration import step_loops
from sst_ros.integration.adaptive_stepper import AdaptiveStepper, EvaluationBudget, Step
from sst_ros.integration.applied_torque import AppliedTorque
from sst_ros.integration.compiled_method import compile_derivative
from sst_ros.integration.events import (
    contact_events_of,
    first_event,
    free_range,
    just_beyond,
    may_occur,
)
from sst_ros.integration.point import Point
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import SineTorque, Torque
from sst_ros.state import Vector3

Moment = tuple[float, ...]
"""External moment on the star in {B} [N m] where the scene takes it from a topic, else empty."""


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
        self.torque = AppliedTorque(self.dynamics, scene.torque_limit, derivative)
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
        torque is one of `AppliedTorque.acting`.

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
                new = self._new_stepper(self.ode, compiled=False, ranges=(), law=self.torque)
            else:
                new = self._new_stepper(ode_under(self.dynamics, sine, self.torque.limit_of(sine)))
            self._others[sine] = new
        return self._others[sine], (*self.torque.begin(torque, start), *moment)

    def steps(
        self, at: Point, start: float, h: float, torque: Torque, moment: Moment
    ) -> Iterator[Step]:
        """Yield the steps of a period: of their own lengths, each up to the first event in it.

        Raises:
            LimitReached, CannotStep, ArithmeticError, ValueError: as `advance`, after the last
                valid step.

        """
        stepper, drive = self._begin_period(torque, start, moment)
        self.budget.begin()
        x = 0.0
        while x < h:
            event = None
            for step in stepper.accepted_steps(x, h, at, drive, start):
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
