# SPDX-License-Identifier: Apache-2.0
"""The solver grid of a work-precision study: methods, each with settings from coarse to fine.

Fixed steps use no error estimate. Tolerances go to the adaptive stepper that `Simulation` steps
with; the coarse solution of its global error estimate is counted and timed with it. Where the
right-hand side has kinks they go to `Simulation` itself, under torques that are functions of time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sst_ros.errors import SstError
from sst_ros.integration.adaptive_stepper import AdaptiveStepper, StepperCheckpoint
from sst_ros.integration.compiled_method import CompiledMethod, Method
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.mechanism.geometry import Array
from sst_ros.studies.initial_value_problem import InitialValueProblem
from sst_ros.studies.reference_solution import ReferenceSolution

FIXED, TOLERANCE = "fixed steps", "tolerance"

_STEPS_PER_INTERVAL = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_TOLERANCES = tuple(10.0**-n for n in range(4, 14))


ABOVE_REFERENCE = 100.0
"""Errors are reported only if they are so many times larger than the reference's own."""

USELESS = 0.1
"""An orientation error above this [rad] is a failure."""

ROUNDING = 2e-14
"""Finer steps are not expected to give less than this [rad]."""

LONGEST_RUN_S = 0.4
"""No finer settings are tried after a run that took longer than this [s]."""

LEAST_SETTINGS = 3
"""So many settings of each method are tried even where they take longer: a busy machine slows one
run, but must not empty the grid."""

SLOWER = 5.0
"""`Simulation` under torques that are functions is plain Python and may take so much longer."""

_REPEAT_S, _REPEATS = 0.15, 15

ERROR = "largest_orientation_rad"
COLUMNS = (
    "scene", "method", "kind", "setting", "evaluations", "wall_min_s", "wall_median_s",
    "final_orientation_rad", "final_gamma_rad", "final_gamma_dot_rad_per_s", ERROR,
    "largest_gamma_rad", "largest_gamma_dot_rad_per_s", "energy_residual_J", "closure_residual",
    "below_floor", "failure",
)  # fmt: skip
"""Columns of the solver grid. `setting` is the length of the steps [s] or the tolerance;
`evaluations` has rejected steps in it, and is empty where they are not counted; errors are empty
for a failure, and `failure` for a success."""


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


def refined(
    settings: Iterator[SolverSetting],
    problem: InitialValueProblem,
    truth: ReferenceSolution,
    longest_s: float,
) -> Iterator[tuple[dict[str, Any], Array]]:
    """Go from coarse to fine until a run takes long or two errors lie below the floor."""
    below, floor = 0, ABOVE_REFERENCE * truth.own.orientation
    for number, setting in enumerate(settings, start=1):
        row, end = _result(setting, problem, truth)
        yield row, end
        error = row.get(ERROR, math.inf)
        below += error < max(floor, ROUNDING)
        slower = SLOWER if problem.kinked and setting.kind == TOLERANCE else 1.0
        if (row["wall_min_s"] > longest_s * slower and number >= LEAST_SETTINGS) or below > 1:
            return


def _result(
    setting: SolverSetting, problem: InitialValueProblem, truth: ReferenceSolution
) -> tuple[dict[str, Any], Array]:
    """Run one setting: its row of the grid, and its last state, nan for a failure."""
    states, evaluations, failure = np.full((1, len(problem.start)), np.nan), None, ""
    wall = (0.0, 0.0)
    with np.errstate(all="ignore"):
        try:
            states, evaluations = setting.solve()
            wall = _timed(setting.timed)
        except (SstError, ArithmeticError, ValueError) as error:
            failure = str(error).splitlines()[0] if str(error) else "not finite"
    if not failure and not np.isfinite(states[:, :7]).all():
        failure = "not finite"
    row = {
        "method": setting.method, "kind": setting.kind, "setting": setting.setting,
        "evaluations": evaluations, "wall_min_s": wall[0], "wall_median_s": wall[1],
    }  # fmt: skip
    if not failure:
        final, largest = problem.errors(states, truth.states)
        if not largest.orientation <= USELESS or not math.isfinite(largest.gamma_dot):
            failure = f"off by {largest.orientation:.1g} rad"
        else:
            errors = (*asdict(final).values(), *asdict(largest).values())
            row |= dict(zip(COLUMNS[7:13], errors, strict=True))
            energy, row["closure_residual"] = problem.residuals(states[-1])
            row["energy_residual_J"] = energy if math.isfinite(energy) else None
            row["below_floor"] = largest.orientation < ABOVE_REFERENCE * truth.own.orientation
    return row | {"failure": failure}, states[-1]


def _timed(run: Callable[[], object]) -> tuple[float, float]:
    walls: list[float] = []
    while len(walls) < 3 or (sum(walls) < _REPEAT_S and len(walls) < _REPEATS):
        began = time.perf_counter()
        run()
        walls.append(time.perf_counter() - began)
        if walls[-1] > LONGEST_RUN_S:
            break
    return min(walls), float(np.median(walls))
