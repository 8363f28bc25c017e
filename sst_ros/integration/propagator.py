# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through one period: steps, limits, contact at compliant stops."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import Any, NamedTuple

from sst_ros.dynamics.limits import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics, Function
from sst_ros.integration import coarse_solution, step_loops
from sst_ros.integration.adaptive_stepper import (
    AcceptedStep,
    AdaptiveStepper,
    EvaluationBudget,
    MethodChange,
    StepperCheckpoint,
)
from sst_ros.integration.applied_torque import AppliedTorque, Torque
from sst_ros.integration.events import (
    contact_events_of,
    first_event,
    free_range,
    just_beyond,
    may_occur,
)
from sst_ros.integration.methods import METHODS, RK4, Rosenbrock
from sst_ros.integration.ode import ODE, ode_with_work
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, SineTorque
from sst_ros.state import State, Vector3

Checkpoint = tuple[
    int, tuple[float, float], AdaptiveStepper, dict[AdaptiveStepper, StepperCheckpoint]
]

_SHARP, _SLIDING = 10.0, 5.0
"""A step loses its order where a rate changes by 10 times the smoothing of a Coulomb torque, at
rates below 5 times; RK4 resolves less sharp ones within the accuracy of the estimate."""


class Point(NamedTuple):
    """Solution y, coarse solution z by a method of that order, nine angles and nine rates."""

    y: list[float]
    z: list[float]
    joints: tuple[float, ...]
    order: int


class Propagator:
    """Advances a scene through periods of constant drive, or of torques that are a function.

    Args:
        scene: what is simulated.
        geometry, dynamics: of the scene.
        integrator: a method of `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step.
        compiled: by numba.
        budget: evaluations that a period may take.
        derivative: derivative of the state in plain Python, in place of the traced one and with
            its inputs; for explicit methods.

    """

    def __init__(
        self,
        scene: Scene,
        geometry: Geometry,
        dynamics: Dynamics,
        integrator: str,
        tolerance: float,
        *,
        compiled: bool,
        budget: EvaluationBudget,
        derivative: Function | None = None,
    ) -> None:
        self._dynamics = dynamics
        self._ode = ode_with_work(dynamics)
        self._limits = tuple(limits_of(scene, geometry))
        self._contacts = tuple(contact_events_of(scene, geometry))
        self._ranges = ranges_of([*self._limits, *free_range(self._contacts)])
        limit = scene.actuators.torque_limit if scene.actuators else None
        self._torque = AppliedTorque(self._ode, limit, derivative)
        self._budget = budget
        self._new_stepper = partial(
            AdaptiveStepper,
            method=integrator,
            tolerance=tolerance,
            compiled=compiled,
            ranges=self._ranges,
            budget=budget,
        )
        self._constant = self._stepper = self._new_stepper(self._ode, derivative=derivative)
        self._sines: dict[SineTorque, AdaptiveStepper] = {}
        # Torque functions are evaluated in Python, and have no Jacobian.
        self._function = AdaptiveStepper(
            self._ode,
            "auto" if isinstance(METHODS.get(integrator), Rosenbrock) else integrator,
            tolerance,
            compiled=False,
            derivative=self._torque.derivative,
            budget=budget,
        )
        self._coulomb = tuple(_coulomb_joints(scene)) if integrator == RK4.name else ()
        self.accepted_steps, self._growth = 0, (0.0, 0.0)
        self._first = self._before = self._checkpoint()

    def reset(self) -> None:
        """Forget what has happened."""
        self._restore(self._first)
        self._before = self._first

    def load(self, at: Point, h: float, moment: tuple[float, ...]) -> None:
        """Have the code loaded that periods of h [s] under constant torques may need."""
        self._constant.load(h, (at.y, at.z, at.joints), (0.0, 0.0, 0.0, *moment))

    def _checkpoint(self) -> Checkpoint:
        """All that the next steps depend on beside the point at which they begin."""
        steppers = {
            x: x.checkpoint() for x in (self._constant, self._function, *self._sines.values())
        }
        return self.accepted_steps, self._growth, self._stepper, steppers

    def _restore(self, checkpoint: Checkpoint) -> None:
        self.accepted_steps, self._growth, self._stepper, steppers = checkpoint
        self._sines = {sine: x for sine, x in self._sines.items() if x in steppers}
        for stepper, kept in steppers.items():
            stepper.restore(kept)

    @property
    def method(self) -> str:
        """Name of the method in use."""
        return self._stepper.method.name

    @property
    def changes(self) -> list[MethodChange]:
        """Changes of method."""
        return self._stepper.history

    def begin(self, y: list[float]) -> Point:
        """Complete quaternion and body rate to a state; no torque yet, no work done."""
        full = [*y, *(0.0,) * (len(self._ode.state) - 7)]
        return Point(full, list(full), self._dynamics.joints(*full[:7]), self._stepper.method.order)

    def traced(self, torque: Torque) -> Torque:
        """Return a sine torque that the actuators clamp as a function; all others as they are."""
        return self._torque.traced(torque)

    def torque_at(self, torque: Torque, time: float, y: list[float]) -> Vector3:
        """Torques that act at a time [s] and a state, within the limit of the actuators [N m]."""
        return self._torque.at(torque, time, y)

    @property
    def evaluations(self) -> int:
        """Evaluations of the derivative since the start; a Jacobian counts as `JACOBIAN_COST`."""
        return self._budget.spent

    def errors(self, at: Point) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s]."""
        lost, total = self._growth
        part = lost / total if lost else 0.0
        return coarse_solution.errors(at.y, at.z, at.order, self.accepted_steps, part)

    def step_many(
        self, at: Point, h: float, count: int, torque: Torque, moment: tuple[float, ...]
    ) -> tuple[Point, int]:
        """Do what `advance` does for up to `count` periods of h [s] that take one step each.

        Returns where the last period ended that was done, and how many were.
        """
        if callable(torque) or isinstance(torque, SineTorque):
            return at, 0
        if self._coulomb:  # the joints are looked at after each period
            count = 1
        before, drive = self._checkpoint(), (*self._torque.limited(torque), *moment)
        self._stepper = self._constant
        done, (y, z, joints) = self._stepper.step_many(
            h, count, (at.y, at.z, at.joints), drive, at.order
        )
        if done == 0:
            return at, 0
        self._before = before
        self.accepted_steps += done
        end = Point(y, z, joints, self._stepper.method.order)
        self._note_lost_order(at, end)
        return end, done

    def advance(
        self,
        at: Point,
        start: float,
        h: float,
        torque: Torque,
        moment: tuple[float, ...],
        state: State,
    ) -> Point:
        """Go on from `at` by h [s]; steps end where contact with a stop begins or ends.

        Raises:
            RunStopped: a limit was reached; it carries `state`, and nothing has changed.
            CannotStep: no step resolves the motion, or the budget is spent.

        """
        before = self._before = self._checkpoint()
        drive = (*self._torque.begin(torque, start), *moment)
        self._budget.begin()
        self._stepper = self._stepper_for(torque)
        self._stepper.origin = start
        try:
            x = 0.0
            while x < h:
                at, x, event = self._until_event(at, x, h, drive)
                if event is not None and event.error is not None:
                    raise event.error(event.reason, start + x, state)
            return at
        except Exception:
            self._restore(before)
            raise

    def repeat_part(self, *arguments: Any) -> Point:
        """`advance` through a part of the last period again, and leave everything as it is now."""
        now, before = self._checkpoint(), self._before
        stepper, history = self._stepper, list(self._stepper.history)
        self._restore(before)
        try:
            return self.advance(*arguments)
        finally:
            stepper.history[:] = history
            self._restore(now)
            self._before = before

    def _stepper_for(self, torque: Torque) -> AdaptiveStepper:
        """Return the stepper of constant torques, of a function, or of a sine, which is traced."""
        if isinstance(torque, SineTorque):
            if torque not in self._sines:
                ode = ODE(self._dynamics, torque, work=True, phases=True)
                self._sines[torque] = self._new_stepper(ode)
            return self._sines[torque]
        return self._function if callable(torque) else self._constant

    def _until_event(
        self, at: Point, x: float, h: float, drive: tuple[float, ...]
    ) -> tuple[Point, float, Limit | None]:
        """Go on from x to h, or to the first limit or contact event before."""
        stepper = self._stepper
        for step in stepper.accepted_steps(x, h, at.y, at.z, drive, at.order):
            self.accepted_steps += 1
            end = self._point(step.y, step.z, step.order)
            self._note_lost_order(at, end)
            if step_loops.all_far(self._ranges, at.joints, end.joints, step.h):  # type: ignore[no-untyped-call]
                at = end
                continue
            part = cache(partial(self._part, stepper, step, at, end, drive))
            found = first_event(self._near(at, end), lambda x: part(x).joints, step.h)  # noqa: B023
            if found is not None:
                x, event = found
                if event.error is None:
                    x = just_beyond(event, x, part(x).joints, step.h)
                return part(x), step.t + x, event
            at = end
        return at, h, None

    def _note_lost_order(self, at: Point, end: Point) -> None:
        """Add up the growth of the difference to the coarse solution, and the part of order 1.

        That is the part of fixed steps over an unresolved sign change of a Coulomb torque.
        """
        if not self._coulomb:
            return
        lost, total = self._growth
        grown = coarse_solution.rate_growth((at.y, at.z), (end.y, end.z))
        for joint, smoothing in self._coulomb:
            v, w = at.joints[joint + 9], end.joints[joint + 9]
            nearest = 0.0 if v * w < 0.0 else min(abs(v), abs(w))
            if abs(w - v) > _SHARP * smoothing and nearest < _SLIDING * smoothing:
                lost += grown
                break
        self._growth = lost, total + grown

    def _near(self, at: Point, end: Point) -> list[Limit]:
        """Limits and contact events that may lie inside a step."""
        near = [x for x in self._limits if x.may_be_crossed(at.joints, end.joints)]
        return near + [x for x in self._contacts if may_occur(x, at.joints, end.joints)]

    def _part(
        self,
        stepper: AdaptiveStepper,
        step: AcceptedStep,
        at: Point,
        end: Point,
        drive: tuple[float, ...],
        x: float,
    ) -> Point:
        """Repeat a part x [s] of an accepted step that led from `at` to `end`."""
        if x == step.h:
            return end
        return self._point(*stepper.repeat(step.t, x, at.y, at.z, drive, at.order))

    def _point(self, y: list[float], z: list[float], order: int) -> Point:
        return Point(y, z, self._dynamics.joints(*y[:7]), order)


def _coulomb_joints(scene: Scene) -> Iterator[tuple[int, float]]:
    """Yield joints with Coulomb friction (0 to 8, by kind and leg), and its smoothing [rad/s]."""
    if scene.friction is not None:
        kinds = scene.friction.gamma, scene.friction.mu, scene.friction.beta
        for kind, friction in enumerate(kinds):
            if friction is not None and (friction.coulomb or friction.static):
                yield from ((3 * kind + k, friction.smoothing) for k in range(3))
