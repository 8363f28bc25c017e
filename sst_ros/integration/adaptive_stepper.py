# SPDX-License-Identifier: Apache-2.0
"""Error-controlled steps through one period, with the method that suits the motion."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import ODE, Function
from sst_ros.integration.applied_torque import AppliedTorque
from sst_ros.integration.compiled_method import (
    JACOBIAN_COST,
    CompiledMethod,
    JointRanges,
    Method,
    Point,
    Vector,
)
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RK4, RODAS5P, Rosenbrock
from sst_ros.mechanism.geometry import Array

GROW = 5.0
"""Largest factor by which a step grows."""

_SAFETY, _SHRINK = 0.9, 0.2
_STIFF, _EASY = 2.0, 0.5
"""Step times fastest decay above which an explicit method is left, and step times fastest rate
below which an implicit one is; explicit methods are stable to about 3."""


def step_factor(error: float, error_order: int) -> float:
    """Factor for the next step after one with a local error, relative to the tolerance."""
    if error == 0.0:
        return GROW
    if not error < float("inf"):
        return _SHRINK
    return float(min(max(_SAFETY * error ** (-1.0 / (error_order + 1)), _SHRINK), GROW))


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


class CannotStep(ArithmeticError):
    """No step is small enough to resolve the motion."""


class BudgetSpent(CannotStep):
    """The evaluations that a period may take are used up."""


class EvaluationBudget:
    """Evaluations of the right-hand side that a period may take; `spent` counts those of a run.

    `per_period` is None for no bound; with `whole_run` they are those of a run, whatever its
    periods.
    """

    def __init__(self, per_period: int | None = None, *, whole_run: bool = False) -> None:
        self.per_period, self._whole_run = per_period, whole_run
        self.spent = 0
        self._end: float = float("inf")

    def begin(self) -> None:
        """Begin a period."""
        if self.per_period is not None:
            self._end = self.per_period + (0 if self._whole_run else self.spent)

    def charge(self, evaluations: int) -> None:
        """Count evaluations before they are made.

        Raises:
            BudgetSpent: the period has none left.

        """
        if self.spent + evaluations > self._end:
            what = "motion" if self._whole_run else "step"
            raise BudgetSpent(f"{self.per_period} evaluations do not reach the end of the {what}")
        self.spent += evaluations


_CHOOSE_EVERY = 16
_CHOOSE_AFTER_REJECTIONS = 3


class Step(NamedTuple):
    """An accepted step, or the part of it before an event."""

    t: float  # when it begins [s], as `method` takes it
    h: float  # its length [s]
    begin: Point
    end: Point
    drive: Vector  # what acts
    method: CompiledMethod  # what has taken it
    last: bool  # whether it ends with the period


class MethodChange(NamedTuple):
    """A change of method."""

    time: float  # [s]
    method: str  # the new one
    reason: str


StepperCheckpoint = tuple[CompiledMethod, float, int, int]


class AdaptiveStepper:
    """Chooses methods and step sizes for an ODE.

    Args:
        method: name of a method in `methods.METHODS`, or auto.
        tolerance: largest local error estimate of a step: of the quaternion, and of the rate
            relative to its length.
        derivative: see `CompiledMethod`; for explicit methods only.
        law: a torque function, whose derivatives take the place of those of the ODE.
        ranges: see `CompiledMethod`.
        joints: nine angles and nine rates of a state's first seven numbers, for the ends of steps.
        doubling: control the steps of RK4, too, by the distance of a pair from one step.

    Attributes:
        history: changes of method.
        budget: as given; `budget.spent` counts evaluations.
        origin: time [s] of the run at which the times of `accepted_steps` are zero.

    """

    def __init__(
        self,
        ode: ODE,
        method: str,
        tolerance: float,
        *,
        compiled: bool,
        derivative: Function | None = None,
        law: AppliedTorque | None = None,
        ranges: JointRanges = (),
        joints: Function = lambda *_: (),
        budget: EvaluationBudget | None = None,
        max_step: float = float("inf"),
        doubling: bool = False,
    ) -> None:
        self.tolerance = tolerance
        self.history: list[MethodChange] = []
        self.budget = budget or EvaluationBudget()
        self.origin = 0.0
        self._ode, self._law, self._max_step = ode, law, max_step
        self._auto, self._compiled = method == "auto", compiled
        self._derivative = derivative if law is None else law.derivative
        self._linearise = None if law is None or not law.is_traced else law.linearise
        self._doubling = doubling and method == RK4.name
        self._ranges, self._joints = ranges, joints
        self._methods: dict[str, CompiledMethod] = {}
        self._current = self._method_of(DORMAND_PRINCE if self._auto else METHODS[method])
        self._h = float("inf")
        self._since_choice = 0

    @property
    def method(self) -> Method:
        """The method in use."""
        return self._current.method

    def load(self, h: float, at: Point, d: Vector) -> None:
        """Have the code of all methods that a run may turn to loaded; nothing else changes."""
        if self._derivative is not None:
            return  # plain Python, and an explicit method to the end
        methods = (DORMAND_PRINCE, DOP853, RODAS5P) if self._auto else (self.method,)
        for method in methods:
            loaded = self._method_of(method)
            loaded.step_pair(0.0, h, at.y, at.z, d)
            loaded.step_many(h, 1, self.tolerance, at, d)
        if self._auto:
            with contextlib.suppress(ArithmeticError, ValueError):  # no finite Jacobian here
                self._ode.eigenvalues(0.0, at.y, d)

    def compile(self) -> None:
        """Take compiled steps from now on, which have the same bits; those of a function stay."""
        if self._derivative is None and not self._compiled:
            self._compiled = True
            self._methods.clear()
            self._current = self._method_of(self.method)

    def checkpoint(self) -> StepperCheckpoint:
        """Return what the next steps depend on, to go back to."""
        return self._current, self._h, self._since_choice, len(self.history)

    def restore(self, checkpoint: StepperCheckpoint) -> None:
        """Forget what has happened since `checkpoint`."""
        self._current, self._h, self._since_choice, changes = checkpoint
        del self.history[changes:]

    def accepted_steps(self, t: float, end: float, at: Point, d: Vector) -> Iterator[Step]:
        """Step from t to end.

        Raises:
            CannotStep: steps shrink below the rounding of time.
            BudgetSpent: the period takes more evaluations than it may.

        """
        rejected, stops = 0, list[float]()
        while True:
            left = end - t
            h = min(self._h, self._max_step, left)
            if left - h < 1e-3 * h:
                h = left
            if stops:  # a step ends before a jump, the next one steps over it
                h = min(h, stops[0] - t)
            machine = self._current
            z = at.coarse(machine.method.order)
            self.budget.charge(machine.pair_cost)
            y, new_z, size = machine.step_pair(t, h, at.y, z, d)
            if self._doubling and size < float("inf"):
                size = machine.doubling_error(h, (at.y, z), (y, new_z))
            factor = self._factor(size)
            if size > self.tolerance:
                stops = self._jump_in(t, h, at.y)
                if stops:
                    self._h = h
                    continue
                self._h = h * min(factor, 1.0)
                if self._h < 1e-15 * max(abs(t), end - t) or self._h < 1e-200:
                    raise CannotStep(f"steps of {self._h:.1e} s do not resolve it")
                rejected += 1
                self._choose_method(t, h, at.y, d, rejected)
                continue
            rejected = 0
            stopped = bool(stops) and h == stops[0] - t
            if stopped or h == left:
                if factor < 1.0 or self._h < float("inf"):
                    self._h = max(self._h, h * factor)
            else:
                self._h = h * factor
            begin, at = at, Point(y, new_z, self._joints(*y[:7]), machine.method.order)
            yield Step(t, h, begin, at, d, machine, h == left)
            if h < left or isinstance(self.method, Rosenbrock):
                self._choose_method(t + h, h, y, d)
            if h == left:
                return
            t = stops.pop(0) if stopped else t + h

    def step_many(self, h: float, count: int, at: Point, d: Vector) -> tuple[int, Point]:
        """Do what `accepted_steps` does for up to `count` periods of h, one step a period.

        Returns how many were done, and where the last one ended: the next may need several steps or
        another method, or leave `ranges`. The bits are those of `accepted_steps`. One call takes at
        most the evaluations of one period's budget.
        """
        if min(self._h, self._max_step) < h or self._derivative is not None:
            return 0, at
        machine = self._current
        method, cost = machine.method, machine.pair_cost
        if self.budget.per_period is not None:
            count = min(count, max(self.budget.per_period // cost, 1))
        implicit = isinstance(method, Rosenbrock)
        if implicit and self._auto:
            count = min(count, _CHOOSE_EVERY - 1 - self._since_choice)
        if at.order != method.order:
            at = at._replace(z=at.coarse(method.order), order=method.order)
        done, end = machine.step_many(h, count, self.tolerance, at, d)
        self.budget.spent += done * cost
        if self._h < GROW * h:
            for size in machine.sizes[:done]:
                self._h = max(self._h, h * self._factor(float(size)))
        if implicit:
            self._since_choice += done
        return done, end

    def step_sequence(
        self, first: int, periods: tuple[Any, Any, Any], at: Point, reached: Any
    ) -> tuple[int, Point]:
        """Advance through periods that take one pair of steps each, from the first on.

        Arguments and results are those of `CompiledMethod.step_sequence`.
        """
        done, end = self._current.step_sequence(first, periods, self.tolerance, at, reached)
        self.budget.spent += (done - first) * self._current.pair_cost
        return done, end

    def part(self, step: Step, x: float) -> Point:
        """Repeat a part x [s] of an accepted step."""
        machine, y = step.method, step.begin.y
        z = step.begin.coarse(machine.method.order)
        if x:
            self.budget.charge(machine.pair_cost)
            y, z, _ = machine.step_pair(step.t, x, y, z, step.drive)
        return Point(y, z, self._joints(*y[:7]), machine.method.order)

    def _factor(self, size: float) -> float:
        order = self.method.order if self._doubling else self.method.error_order
        return step_factor(size / self.tolerance, order)

    def _choose_method(self, t: float, h: float, y: Vector, d: Vector, rejected: int = 0) -> None:
        """Change the method if, by the eigenvalues of the Jacobian, another takes longer steps.

        After every 16 attempts, and after 3 rejections in a row: a Coulomb torque that changes sign
        sharply would otherwise shrink explicit steps below its time constant before it is seen.
        """
        self._since_choice += 1
        early = rejected == _CHOOSE_AFTER_REJECTIONS and not isinstance(self.method, Rosenbrock)
        if not self._auto or (self._derivative is not None and self._linearise is None):
            return
        if self._since_choice < _CHOOSE_EVERY and not early:
            return
        if not early:
            self._since_choice = 0
        self.budget.charge(JACOBIAN_COST)
        try:
            eigenvalues = self._eigenvalues(t, y, d)
        except (ArithmeticError, ValueError):
            return  # no finite Jacobian here; the step size has to do
        method, reason = better_method(
            self.method, self.tolerance, h * eigenvalues, only_stiff=early
        )
        if method is not self.method:
            self._current = self._method_of(method)
            self.history.append(MethodChange(self.origin + t, method.name, reason))

    def _jump_in(self, t: float, h: float, y: Vector) -> list[float]:
        """Return times just before and after a jump of the derivative in a step, if any."""
        found = self._law.jump(t, t + h, y) if self._law is not None else None
        if found is None or h < 1e-13 * max(abs(self.origin + t), h):
            return []
        margin = 4e-16 * max(abs(self.origin + found[1]), h)
        return [time for time in (found[0] - margin, found[1] + margin) if time > t]

    def _eigenvalues(self, t: float, y: Vector, d: Vector) -> Array:
        if self._linearise is None:
            return self._ode.eigenvalues(t, y, d)
        size = len(y)
        matrix = [[0.0] * size for _ in range(size)]
        self._linearise(t, y, d, (), [0.0] * size, [0.0] * size, matrix)
        return np.asarray(np.linalg.eigvals(np.array(matrix)))

    def _method_of(self, method: Method) -> CompiledMethod:
        if method.name not in self._methods:
            self._methods[method.name] = CompiledMethod(
                self._ode,
                method,
                compiled=self._compiled,
                derivative=self._derivative,
                linearise=self._linearise,
                ranges=self._ranges,
            )
        return self._methods[method.name]
