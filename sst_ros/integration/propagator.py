# SPDX-License-Identifier: Apache-2.0
"""Propagation of a scene's state through periods: steps, limits, contact at elastic stops.

A coarse solution takes steps of twice the length (Richardson extrapolation): its distance tends to
2^order - 1 times the error of the run as steps shrink, and costs half a step.

The ticks of a recorded run are propagated again by `TickPropagator`, all in one call.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.model import Limit, limits_of, ranges_of
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, ode_under, ode_with_work
from sst_ros.integration import step_loops
from sst_ros.integration.adaptive_stepper import (
    AdaptiveStepper,
    CannotStep,
    EvaluationBudget,
    MethodChange,
    Step,
    StepperCheckpoint,
)
from sst_ros.integration.applied_torque import AppliedTorque, Torque
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import Point
from sst_ros.integration.events import (
    contact_events_of,
    first_event,
    free_range,
    just_beyond,
    load_root_finder,
    may_occur,
)
from sst_ros.integration.methods import DOP853, RK4
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, Vector3

_ROUNDING = 64 * 2.220446049250313e-16

_SHARP, _SLIDING = 10.0, 5.0
"""A step loses its order where a rate changes by 10 times the smoothing of a Coulomb torque, at
rates below 5 times; RK4 resolves less sharp ones within the accuracy of the estimate."""


def orientation_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Angle between the orientations of two states that are near [rad]; q and -q are the same."""
    return 2.0 * min(math.dist(y[:4], z[:4]), math.dist(y[:4], [-x for x in z[:4]]))


def _steps_over_sign_change(at: Point, end: Point, joint: int, smoothing: float) -> bool:
    v, w = at.joints[joint + 9], end.joints[joint + 9]
    nearest = 0.0 if v * w < 0.0 else min(abs(v), abs(w))
    return abs(w - v) > _SHARP * smoothing and nearest < _SLIDING * smoothing


def coulomb_joints(scene: Scene) -> Iterator[tuple[int, float]]:
    """Yield joints with Coulomb friction (0 to 8, by kind and leg), and its smoothing [rad/s]."""
    if scene.friction is not None:
        kinds = scene.friction.gamma, scene.friction.mu, scene.friction.beta
        for kind, friction in enumerate(kinds):
            if friction is not None and (friction.coulomb or friction.static):
                yield from ((3 * kind + k, friction.smoothing) for k in range(3))


class LimitReached(Exception):
    """A limit of the scene ends the motion at a time [s]."""

    def __init__(self, limit: Limit, time: float) -> None:
        self.limit, self.time = limit, time
        super().__init__(limit.reason)


Checkpoint = tuple[int, tuple[float, float], AdaptiveStepper, AdaptiveStepper, StepperCheckpoint]
"""All that a period changes beside the point: accepted steps, growth of the distance of the two
solutions, the stepper in use before it; the stepper of the period, and how that was."""


class Propagator:
    """Advances a scene through periods of constant drive, or of torques that are a function.

    Args:
        scene: what is simulated.
        integrator: a method of `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step.
        derivative: of the state in plain Python, in place of the traced one and with its inputs;
            for explicit methods, and for torques that are numbers or functions.
        limits: whether the limits of the scene end the motion.
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
        self.torque = AppliedTorque(self.ode, scene.torque_limit, derivative)
        self._new_stepper = partial(
            AdaptiveStepper, method=integrator, tolerance=tolerance, compiled=compiled,
            ranges=self._ranges, joints=self.dynamics.joints, budget=budget, max_step=max_step,
            doubling=observe is not None,
        )  # fmt: skip
        self._observe = observe
        self._constant = self._stepper = self._new_stepper(self.ode, derivative=derivative)
        self._others: dict[SineTorque | None, AdaptiveStepper] = {}
        self._fresh: list[tuple[AdaptiveStepper, StepperCheckpoint]] = []
        self.accepted_steps = 0
        # Fixed steps may step over a sign change of sharp friction.
        self._coulomb = tuple(coulomb_joints(scene)) if integrator == RK4.name else ()
        self._growth = 0.0, 0.0  # of the distance of the body rates: in steps of order 1, in all
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
        stepper = self._stepper_for(torque)
        numbers = torque if type(torque) is tuple else self.torque.begin(torque, start)
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
        for stepper, fresh in self._fresh:  # their code stays loaded
            stepper.restore(fresh)
        self._before = self._first

    def load(self, at: Point, h: float, moment: tuple[float, ...]) -> None:
        """Have the code loaded that periods of h [s] under constant torques may need."""
        load_root_finder()
        self._constant.load(h, at, (0.0, 0.0, 0.0, *moment))

    def compile(self) -> None:
        """Take compiled steps from now on; the bits are the same."""
        self._new_stepper.keywords["compiled"] = True
        self.torque.compile()
        for stepper in (self._constant, *self._others.values()):
            stepper.compile()

    def acting(self, torque: Torque, time: float, at: Point) -> Vector3:
        """Torques that the actuators give at a time [s] and a point [N m]."""
        if len(self.dynamics.state) > 7:  # they lag
            return at.y[7], at.y[8], at.y[9]
        return self.torque.at(torque, time, at.y)

    def errors(self, at: Point) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s].

        Twice the asymptotic value: at loose tolerances the terms of higher order hide a part of it.
        """
        y, z = at.y, at.z
        lost, total = self._growth
        rounding = _ROUNDING * math.sqrt(self.accepted_steps + 1.0)
        share = max(2.0 / (2.0**at.order - 1.0), lost / total if lost else 0.0)
        turned, apart = orientation_distance(y, z), math.dist(y[4:7], z[4:7])
        speed = max(1.0, math.hypot(*y[4:7]))
        return (
            max(turned * share, min(turned, rounding)),
            max(apart * share, min(apart, rounding * speed)),
        )

    def _checkpoint(self, stepper: AdaptiveStepper) -> Checkpoint:
        """Return what to go back to after a period by this stepper."""
        return self.accepted_steps, self._growth, self._stepper, stepper, stepper.checkpoint()

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
                new = self._new_stepper(self.ode, compiled=False, ranges=(), law=self.torque)
            else:
                new = self._new_stepper(ode_under(self.dynamics, sine, self.torque.limit_of(sine)))
            self._others[sine] = new
            self._fresh.append((new, new.checkpoint()))
        return self._others[sine]

    def _step_many(
        self, at: Point, h: float, count: int, drive: tuple[float, ...]
    ) -> tuple[Point, int]:
        """Advance by up to `count` periods of h [s] that take one pair of steps each."""
        # With Coulomb friction the joints are looked at after each period.
        done, end = self._stepper.step_many(h, 1 if self._coulomb else count, at, drive)
        if done:
            self._count_steps(done, at, end)
        return end, done

    def _count_steps(self, count: int, at: Point, end: Point) -> None:
        """Count steps, and where they may be of order 1 how the solutions have grown apart."""
        self.accepted_steps += count
        if self._coulomb:
            lost, total = self._growth
            old, new = ([a - b for a, b in zip(x.y[4:7], x.z[4:7], strict=True)] for x in (at, end))
            grown = math.dist(old, new)
            sharp = any(_steps_over_sign_change(at, end, *one) for one in self._coulomb)
            self._growth = lost + (grown if sharp else 0.0), total + grown

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
            self._count_steps(1, step.begin, step.end)
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


LONGEST_TICK_NS = 1_000_000
"""Longer ticks are divided [ns]: a pair of steps then takes half a millisecond each."""

_TICK_TOLERANCE, _TICK_BUDGET = 1e-13, 3600
"""Largest local error estimate of a pair of steps; evaluations that a tick may take: a hundred
pairs of steps."""


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
            Solution and coarse solution at the end of each tick, with the work since the start
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
        stepper = self._stepper_for(self._sine or (0.0, 0.0, 0.0))
        at, k = self.begin(starts[0, :-1].tolist()), 0
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
