# SPDX-License-Identifier: Apache-2.0
"""The reference solution of a work-precision study, with its own error.

The step size is halved in double precision until the solution stops improving; then DOP853 solves
with that step in extended precision. The reference's own error is twice the difference of two
step sizes.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array
from sst_ros.studies.high_precision import EXTENDED, HighPrecisionDop853, LongArray
from sst_ros.studies.initial_value_problem import InitialValueProblem, StateError

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
        kind: high_precision.EXTENDED or high_precision.MPMATH.
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
        how = f"DOP853, {problem.interval / steps[1]:.3g} s steps, {solver.numbers.name}"
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
