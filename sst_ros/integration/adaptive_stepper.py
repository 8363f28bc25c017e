# SPDX-License-Identifier: Apache-2.0
"""Error-controlled steps through one period, with the method that suits the motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import ODE, Function
from sst_ros.integration import step_loops
from sst_ros.integration.compiled_method import (
    JACOBIAN_COST,
    CompiledMethod,
    JointRanges,
    MethodChange,
    Periods,
    Point,
    TorqueLaw,
    Vector,
    methods_of,
)
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RODAS5P, Method, Rosenbrock
from sst_ros.mechanism.geometry import Array

_STIFF, _EASY = 2.0, 0.5
"""Step times fastest decay above which an explicit method is left, and step times fastest rate
below which an implicit one is; explicit methods are stable to about 3."""


def better_method(
    method: Method, tolerance: float, steps: Array, *, only_stiff: bool
) -> tuple[Method, str]:
    """Choose the method that would take longer steps, the one in use if none is, and state why.

    `steps` is the length of a step times the eigenvalues of the Jacobian; `only_stiff` looks for
    stiffness alone.
    """
    radius, decay = abs(steps).max(), -steps.real.min()
    implicit = isinstance(method, Rosenbrock)
    if not implicit and decay > _STIFF and decay > 0.5 * radius:
        return RODAS5P, f"stiff: step times fastest decay is {decay:.2g}"
    if only_stiff:
        return method, ""
    if implicit and radius < _EASY:
        return DORMAND_PRINCE, f"no longer stiff: step times rate is {radius:.2g}"
    if method is DORMAND_PRINCE and tolerance < 1e-7 and decay <= _STIFF:
        return DOP853, "many small steps that accuracy asks for"
    return method, ""


class CannotStep(Exception):
    """No step is small enough to resolve the motion."""


class BudgetSpent(CannotStep):
    """The evaluations that a period may take are used up."""


WHOLE_MOTION_BUDGET = 10_000_000
"""Evaluations where a period may be a whole motion, offline: minutes in plain Python."""


class EvaluationBudget:
    """Evaluations of the right-hand side that a period, or a whole run, may take.

    `spent` counts those of a run.
    """

    def __init__(self, per_period: int, *, whole_run: bool = False) -> None:
        self.per_period, self._whole_run = per_period, whole_run
        self.spent, self._end = 0, per_period

    def begin(self) -> None:
        """Begin a period."""
        if not self._whole_run:
            self._end = self.per_period + self.spent

    def charge(self, evaluations: int) -> None:
        """Count evaluations before they are made; BudgetSpent: the period has none left."""
        if self.spent + evaluations > self._end:
            what = "motion" if self._whole_run else "step"
            raise BudgetSpent(f"{self.per_period} evaluations do not reach the end of the {what}")
        self.spent += evaluations


_CHOOSE_EVERY = 16
_CHOOSE_AFTER_REJECTIONS = 3


class Step(NamedTuple):
    """An accepted step, or the part of it before an event."""

    t: float  # when it begins [s], as `machine` takes it
    h: float  # its length [s]
    begin: Point
    end: Point
    drive: Vector  # what acts
    other: Vector | None  # on the second solution, None where it is the same
    machine: CompiledMethod  # what has taken it
    last: bool  # whether it ends with the period

    def inside(self, x: float) -> Point:
        """Return the solution x [s] after its begin, by one shorter step; not the second one.

        ArithmeticError: it is not finite.
        """
        at, size = self.machine.step_pair(self.t, x, self.begin, self.drive, parts=1)
        if size == math.inf:
            raise ArithmeticError("a state inside a step is not finite")
        return at


class AdaptiveStepper:
    """Chooses methods and step sizes for an ODE, by what is in a point and nothing else.

    Args:
        method: name of a method in `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step: of the quaternion, and of the rate
            relative to its length.
        law: derivatives that take the place of those of the ODE.
        ranges: see `CompiledMethod`.
        joints: nine angles and nine rates of a state's first seven numbers, for the ends of steps.
        budget: counts evaluations, and ends a period that takes too many.
        max_step: longest step [s].

    """

    def __init__(
        self,
        ode: ODE,
        method: str,
        tolerance: float,
        *,
        compiled: bool,
        joints: Function,
        budget: EvaluationBudget,
        max_step: float,
        ranges: JointRanges = (),
        law: TorqueLaw | None = None,
    ) -> None:
        self.tolerance, self.budget = tolerance, budget
        self._ode, self._law, self._max_step = ode, law, max_step
        self._methods, self._compiled = methods_of(method), compiled
        self._chooses = len(self._methods) > 1
        self._most_attempts = _CHOOSE_EVERY - 1 if self._chooses else math.inf
        self._ranges, self._joints = ranges, joints
        self._machines: dict[str, CompiledMethod] = {}

    def begin(self, y: list[float]) -> Point:
        """Return the point at which a run begins; numbers that y lacks at its end are zero."""
        full = [*y, *(0.0,) * (len(self._ode.state) - len(y))]
        return Point(full, list(full), self._joints(*full[:7]), self._methods[0])

    def load(self) -> None:
        """Have the code of all methods that a run may turn to loaded, or made."""
        for method in self._methods:
            self._machine(method).load()
        if self._chooses:
            _ = self._ode.linearised

    def compile(self) -> None:
        """Take compiled steps from now on, which have the same bits; those of a function stay."""
        if self._law is None and not self._compiled:
            self._compiled = True
            self._machines.clear()

    def accepted_steps(
        self,
        t: float,
        end: float,
        at: Point,
        d: Vector,
        origin: float = 0.0,
        other: Vector | None = None,
    ) -> Iterator[Step]:
        """Step from t to end; `origin` is the time of the run at which these are zero [s].

        The second solution has the drive `other`, by default that of the first. CannotStep: steps
        shrink below the rounding of time. BudgetSpent: the period takes more evaluations than it
        may.
        """
        rejected, stops = 0, list[float]()
        while True:
            left = end - t
            h = min(at.h, self._max_step, left)
            if left - h < 1e-3 * h:
                h = left
            if stops:  # a step ends before a jump, the next one steps over it
                h = min(h, stops[0] - t)
            machine = self._machine(at.method)
            self.budget.charge((3 if other is None else 6) * machine.cost)
            after, size = machine.step_pair(t, h, at, d, other=other)
            error, order = size / self.tolerance, at.method.error_order
            if size > self.tolerance:
                stops = self._jump_in(t, h, at.y, origin)
                if stops:
                    at = at._replace(h=h)
                    continue
                at = at._replace(h=h * min(step_loops.step_factor(error, order), 1.0))
                if at.h < 1e-15 * max(abs(t), end - t) or at.h < 1e-200:
                    raise CannotStep(f"steps of {at.h:.1e} s do not resolve it")
                rejected += 1
                at = self._choose_method(t, h, at, d, origin, rejected)
                continue
            rejected = 0
            stopped = bool(stops) and h == stops[0] - t
            longest = step_loops.next_length(at.h, h, error, order, stopped or h == left)
            begin = at
            at = after._replace(h=longest, attempts=at.attempts)
            if h < left or isinstance(at.method, Rosenbrock):
                at = self._choose_method(t + h, h, at, d, origin)
            yield Step(t, h, begin, at, d, other, machine, h == left)
            if h == left:
                return
            t = stops.pop(0) if stopped else t + h

    def step_many(self, h: float, count: int, at: Point, d: Vector) -> tuple[int, Point]:
        """Do what `accepted_steps` does for up to `count` periods of h, with the same bits.

        Returns how many were done, and where the last one ended: in the next a step is rejected,
        the method is looked at, or `ranges` may be left. One call takes at most the evaluations of
        one period's budget.
        """
        return self.step_through(0, count, self._machine(at.method).hold(h, d), at, 1)

    def step_through(
        self, first: int, end: int, periods: Periods, at: Point, budgets: int, reached: Any = None
    ) -> tuple[int, Point]:
        """Advance as `CompiledMethod.step_many`, by the evaluations of so many budgets at most."""
        machine = self._machine(at.method)
        steps = max(budgets * self.budget.per_period // (3 * machine.cost), 1)
        most = self._max_step, self._most_attempts, at.steps + steps
        done, after = machine.step_many(first, end, periods, at, self.tolerance, most, reached)
        self.budget.spent += 3 * (after.steps - at.steps) * machine.cost
        return done, after

    def part(self, step: Step, x: float) -> Point:
        """Return the point x [s] after the begin of an accepted step, by a shorter one."""
        self.budget.charge((3 if step.other is None else 6) * step.machine.cost)
        end, _ = step.machine.step_pair(step.t, x, step.begin, step.drive, other=step.other)
        return step.end._replace(y=end.y, z=end.z, joints=end.joints)

    def _choose_method(
        self, t: float, h: float, at: Point, d: Vector, origin: float, rejected: int = 0
    ) -> Point:
        """Change the method if, by the eigenvalues of the Jacobian, another takes longer steps.

        After every 16 attempts, and after 3 rejections in a row: a Coulomb torque that changes sign
        sharply would otherwise shrink explicit steps below its time constant before it is seen.
        """
        at = at._replace(attempts=at.attempts + 1)
        early = rejected == _CHOOSE_AFTER_REJECTIONS and not isinstance(at.method, Rosenbrock)
        if not self._chooses or (self._law and not self._law.linearise):
            return at
        if at.attempts < _CHOOSE_EVERY and not early:
            return at
        if not early:
            at = at._replace(attempts=0)
        self.budget.charge(JACOBIAN_COST)
        try:
            eigenvalues = self._eigenvalues(t, at.y, d)
        except (ArithmeticError, ValueError):
            return at  # no finite Jacobian here; the step size has to do
        method, reason = better_method(at.method, self.tolerance, h * eigenvalues, only_stiff=early)
        if method is at.method:
            return at
        change = MethodChange(origin + t, method.name, reason)
        return at._replace(method=method, changes=(*at.changes, change))

    def _jump_in(self, t: float, h: float, y: Vector, origin: float) -> list[float]:
        """Return times just before and after a jump of the derivative in a step, if any."""
        found = self._law.jump(t, t + h, y) if self._law else None
        if found is None or h < 1e-13 * max(abs(origin + t), h):
            return []
        margin = 4e-16 * max(abs(origin + found[1]), h)
        return [time for time in (found[0] - margin, found[1] + margin) if time > t]

    def _eigenvalues(self, t: float, y: Vector, d: Vector) -> Array:
        if self._law is None or self._law.linearise is None:
            return self._ode.eigenvalues(t, y, d)
        size = len(y)
        matrix = [[0.0] * size for _ in range(size)]
        self._law.linearise(t, y, d, (), [0.0] * size, [0.0] * size, matrix)
        return np.asarray(np.linalg.eigvals(np.array(matrix)))

    def _machine(self, method: Method) -> CompiledMethod:
        if method.name not in self._machines:
            self._machines[method.name] = CompiledMethod(
                self._ode,
                method,
                compiled=self._compiled,
                law=self._law,
                ranges=self._ranges,
            )
        return self._machines[method.name]
