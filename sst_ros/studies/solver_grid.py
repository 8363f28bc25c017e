# SPDX-License-Identifier: Apache-2.0
"""The solver grid of a work-precision study: methods, each with settings from coarse to fine.

Fixed steps use no error estimate. Tolerances go to the adaptive stepper that `Simulation` steps
with; the coarse solution of its global error estimate is counted and timed with it. Where the
right-hand side has kinks they go to `Simulation` itself, under torques that are functions of time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.integration.adaptive_stepper import AdaptiveStepper, StepperCheckpoint
from sst_ros.integration.compiled_method import CompiledMethod, Method
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.mechanism.geometry import Array
from sst_ros.studies.initial_value_problem import InitialValueProblem

FIXED, TOLERANCE = "fixed steps", "tolerance"

_STEPS_PER_INTERVAL = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_TOLERANCES = tuple(10.0**-n for n in range(4, 14))


@dataclass(frozen=True)
class SolverSetting:
    """One point of the grid.

    Attributes:
        method: name of the method.
        kind: FIXED or TOLERANCE.
        setting: length of the steps [s], or the tolerance.
        solve: returns the states at the instants, and the evaluations of the right-hand side,
            None where they are not counted. Raises SstError, ArithmeticError or ValueError.
        timed: does the same work with the least overhead.

    """

    method: str
    kind: str
    setting: float
    solve: Callable[[], tuple[Array, int | None]]
    timed: Callable[[], object]


def solver_grid(problem: InitialValueProblem, compiled: bool) -> list[Iterator[SolverSetting]]:
    """Return the settings by method and kind, each from coarse to fine."""
    found: list[Iterator[SolverSetting]] = []
    for method in METHODS.values():
        if not problem.clamped:  # fixed steps know no limit of torque
            found.append(_fixed(problem, method, compiled))
        if not method.error_order:
            continue
        if not problem.kinked:
            found.append(_adaptive(problem, method, compiled))
        elif not isinstance(method, Rosenbrock):  # which takes no torques that are functions
            found.append(_simulated(problem, method))
    return found


def _fixed(problem: InitialValueProblem, method: Method, compiled: bool) -> Iterator[SolverSetting]:
    machine = CompiledMethod(problem.system, method, compiled=compiled)
    for steps in _STEPS_PER_INTERVAL:
        count, h = steps * problem.count, problem.interval / steps

        def solve(steps: int = steps, count: int = count) -> tuple[Array, int]:
            return problem.fixed_steps(machine, steps), len(method.a) * count

        def timed(count: int = count, h: float = h) -> None:
            machine.step_fixed(0.0, h, count, list(problem.start), problem.drive)

        yield SolverSetting(method.name, FIXED, h, solve, timed)


def _adaptive(
    problem: InitialValueProblem, method: Method, compiled: bool
) -> Iterator[SolverSetting]:
    for tolerance in _TOLERANCES:
        stepper = AdaptiveStepper(problem.system, method.name, tolerance, compiled=compiled)

        def run(
            stepper: AdaptiveStepper = stepper,
            fresh: StepperCheckpoint = stepper.checkpoint(),  # noqa: B008
        ) -> Array:
            stepper.restore(fresh)
            rows = [list(problem.start)]
            y, coarse, order = list(problem.start), list(problem.start), method.order
            for k in range(problem.count):
                begin, end = k * problem.interval, (k + 1) * problem.interval
                for step in stepper.accepted_steps(begin, end, y, coarse, problem.drive, order):
                    y, coarse, order = step.y, step.z, step.order
                rows.append(y)
            return np.array(rows)

        def solve(
            stepper: AdaptiveStepper = stepper, run: Callable[[], Array] = run
        ) -> tuple[Array, int]:
            before = stepper.budget.spent
            states = run()
            return states, stepper.budget.spent - before

        yield SolverSetting(method.name, TOLERANCE, tolerance, solve, run)


def _simulated(problem: InitialValueProblem, method: Method) -> Iterator[SolverSetting]:
    for tolerance in _TOLERANCES:

        def solve(tolerance: float = tolerance) -> tuple[Array, None]:
            return problem.simulated(method.name, tolerance), None

        yield SolverSetting(method.name, TOLERANCE, tolerance, solve, solve)
