# SPDX-License-Identifier: Apache-2.0
"""The reference solution of a work-precision study: beyond double precision, with its own error.

The step size is halved in double precision until the solution stops improving; then DOP853 solves
with that step in extended precision. The reference's own error is twice the difference of two
step sizes.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.expression import Program
from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array
from sst_ros.studies.initial_value_problem import InitialValueProblem, StateError

LongArray: TypeAlias = NDArray[np.longdouble]
EXTENDED, MPMATH = "long double", "mpmath"

DIGITS = 30
"""Decimal digits of mpmath's numbers."""

LONGEST_S = 20.0
"""The reference stays in double precision where extended precision would take more than this [s]:
a work-precision study of one scene then stays below a minute."""

_MOST_STEPS = 200_000


@dataclass(frozen=True)
class ReferenceSolution:
    """States at the instants of comparison, their own error, and how they were found."""

    states: LongArray
    own: StateError
    how: str


def solve_reference(
    problem: InitialValueProblem, kind: str = EXTENDED, *, compiled: bool
) -> ReferenceSolution:
    """Solve a problem as accurately as possible.

    Args:
        problem: what is solved.
        kind: EXTENDED or MPMATH.
        compiled: search for the step size under numba.

    Raises:
        InputError: there is no finite motion, or mpmath is asked for and not installed.

    """
    if problem.kinked:
        rough, fine = (
            problem.simulated("dop853", tolerance).astype(np.longdouble)
            for tolerance in (1e-13, 1e-14)
        )
        how = "Simulation, dop853, tolerance 1e-14"
        return ReferenceSolution(fine, _own(problem, rough, fine), how)
    machine = CompiledMethod(problem.system, DOP853, compiled=compiled)
    best, solution = _finest(problem, machine)
    solver = HighPrecisionDop853(problem.system.program, kind, problem.drive)
    began = time.perf_counter()
    for _ in range(3):
        solver.evaluate(problem.start)
    seconds = (time.perf_counter() - began) / 3 * 1.5 * 12 * problem.count
    steps = (3 * best // 2, 2 * best)
    if kind != EXTENDED or seconds * sum(steps) < LONGEST_S:
        rough, fine = (
            solver.solve(problem.start, problem.interval, problem.count, n) for n in steps
        )
        how = f"DOP853, {problem.interval / steps[1]:.3g} s steps, {solver.numbers}"
    else:
        fine = solution.astype(np.longdouble)
        rough = problem.fixed_steps(machine, best // 2).astype(np.longdouble)
        how = f"DOP853, {problem.interval / best:.3g} s steps, double precision"
    return ReferenceSolution(fine, _own(problem, rough, fine), how)


def _finest(problem: InitialValueProblem, machine: CompiledMethod) -> tuple[int, Array]:
    """Halve the step until rounding dominates; return steps an interval, and the solution."""
    found: list[tuple[float, int, Array]] = []
    before = problem.fixed_steps(machine, 1)
    for power in range(1, 14):
        after = problem.fixed_steps(machine, 2**power)
        change = problem.errors(before, after.astype(np.longdouble))[1].orientation
        if math.isfinite(change):
            found.append((change, 2**power, after))
        converged = len(found) > 1 and (change < 1e-13 or change > found[-2][0] < 1e-9)
        if converged or problem.count * 2**power > _MOST_STEPS:
            break
        before = after
    if not found:
        problems = [Problem("duration", problem.scene.duration, "the reference is not finite")]
        raise InputError(problem.scene.name, problems)
    _, steps, solution = min(found, key=lambda row: row[0])
    return steps, solution


def _own(problem: InitialValueProblem, rough: LongArray, fine: LongArray) -> StateError:
    """Return twice the difference of two step sizes, but not less than doubles resolve."""
    change, joints = problem.errors(rough, fine)[1], np.abs(problem.joints(fine))
    gamma, rate = (2.3e-16 * float(joints[:, i : i + 3].max()) for i in (0, 9))
    return StateError(
        max(2.0 * change.orientation, 1e-17),
        max(2.0 * change.gamma, gamma),
        max(2.0 * change.gamma_dot, rate),
    )


class HighPrecisionDop853:
    """DOP853 with fixed steps on a number type: the integration package runs on doubles only.

    It evaluates the same traced program, so that it solves what the methods solve to the last bit.

    Args:
        program: derivative with the inputs t, state, drive.
        kind: EXTENDED or MPMATH.
        drive: constant inputs.

    Attributes:
        numbers: which numbers it calculates with, for reports.

    Raises:
        MissingDependency: mpmath is asked for and not installed.

    """

    def __init__(self, program: Program, kind: str, drive: Sequence[float]) -> None:
        names = ("sqrt", "sin", "cos", "tanh", "exp")
        if kind == EXTENDED:
            self.numbers = f"{np.finfo(np.longdouble).precision}-digit floats"
            namespace = {each: getattr(np, each) for each in names} | {"atan2": np.arctan2}
            self._number: Any = np.longdouble
            self._long: Callable[[Any], np.longdouble] = np.longdouble
        else:
            mpmath = require("mpmath")
            context = mpmath.mp.clone()
            context.dps = DIGITS
            self.numbers = f"mpmath, {DIGITS} digits"
            namespace = {each: getattr(context, each) for each in (*names, "atan2")}
            self._number = context.mpf
            self._long = lambda x: np.longdouble(mpmath.nstr(x, DIGITS))
        exec(program.source("rhs"), namespace)
        self._rhs: Callable[..., tuple[Any, ...]] = namespace["rhs"]
        self._sqrt: Callable[[Any], Any] = namespace["sqrt"]
        number = self._number
        self._drive = tuple(map(number, drive))
        self._a = [[(i, number(w)) for i, w in enumerate(row) if w] for row in DOP853.a]
        weights = [number(w) for w in DOP853.b]
        # As doubles they do not quite add up to 1, which no step size would show.
        weights[-1] = number(1) - sum(weights[:-1], number(0))
        self._b = [(i, w) for i, w in enumerate(weights) if DOP853.b[i]]
        self._c = [number(c) for c in DOP853.c]

    def solve(self, start: Sequence[float], interval: float, count: int, steps: int) -> LongArray:
        """Return states at k * interval [s], k = 0 .. count, shape (count + 1, len(start)).

        The first four numbers are a quaternion, which is kept at length 1. A row of nan stands
        where there is no finite state.
        """
        number = self._number
        result = np.full((count + 1, len(start)), np.nan, dtype=np.longdouble)
        y = [number(x) for x in start]
        h = number(interval) / steps
        result[0] = [self._long(x) for x in y]
        with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
            for k in range(count):
                for step in range(steps):
                    y = self._step((k * steps + step) * h, y, h)
                result[k + 1] = [self._long(x) for x in y]
        return result

    def evaluate(self, start: Sequence[float]) -> tuple[Any, ...]:
        """Evaluate the derivative once, at time zero, to measure its computing time."""
        number = self._number
        return self._rhs(number(0), *map(number, start), *self._drive)

    def _step(self, t: Any, y: list[Any], h: Any) -> list[Any]:
        slopes: list[tuple[Any, ...]] = []
        for row, node in zip(self._a, self._c, strict=True):
            at = [x + h * sum(w * slopes[i][j] for i, w in row) for j, x in enumerate(y)]
            slopes.append(self._rhs(t + node * h, *at, *self._drive))
        new = [x + h * sum(w * slopes[i][j] for i, w in self._b) for j, x in enumerate(y)]
        length = self._sqrt(sum(x * x for x in new[:4]))
        return [x / length for x in new[:4]] + new[4:]
