# SPDX-License-Identifier: Apache-2.0
"""Work-precision study: error and computing time of every method and setting on a scene.

Each method has settings from coarse to fine. Fixed steps use no error estimate; those of Gauss
collocation are of a motion that was prepared. Tolerances go to `Simulation`, whose estimate of the
global error is counted and timed with it, and for collocation to `prepare`.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sst_ros.errors import SstError
from sst_ros.host.compiled_module import numba_version
from sst_ros.host.output import slices
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import METHODS, RK4
from sst_ros.mechanism.geometry import Array
from sst_ros.report.reference import compare_with_paper
from sst_ros.report.reference_solution import (
    EXTENDED,
    InitialValueProblem,
    ReferenceSolution,
    solve_reference,
)
from sst_ros.report.results import data_frame
from sst_ros.report.scene_summary import StepAdvice, step_advice
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulate import PreparedRun, prepare, simulate
from sst_ros.simulation.simulate_gauss import GAUSS

if TYPE_CHECKING:
    from pandas import DataFrame, Series

FIXED, TOLERANCE = "fixed steps", "tolerance"

_STEPS_PER_INTERVAL = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)
_TOLERANCES = tuple(10.0**-n for n in range(4, 14))

ABOVE_REFERENCE = 100.0  # errors are reported if they are so many times the reference's own
USELESS = 0.1  # an orientation error above this [rad] is a failure
ROUNDING = 2e-14  # finer steps are not expected to give less than this [rad]
LONGEST_RUN_S = 0.4  # no finer settings are tried after a run that took longer than this [s]
LEAST_SETTINGS = 3
"""So many settings of each method are tried even where they take longer: a busy machine slows one
run, but must not empty the grid."""
SLOWER = 5.0  # so much longer `Simulation` may take under clamped torques, in plain Python
SAME_EQUATIONS = 1e-10  # kernel and the paper's equations must agree to this part
_REPEAT_S, _REPEATS = 0.15, 15

ERROR = "largest_orientation_rad"
ERRORS = [
    f"{when}_{quantity}"
    for when in ("final", "largest")
    for quantity in ("orientation_rad", "gamma_rad", "gamma_dot_rad_per_s")
]
COLUMNS = (
    *("scene", "method", "kind", "setting", "evaluations", "wall_min_s", "wall_median_s"),
    *(*ERRORS, "energy_residual_J", "closure_residual", "below_floor", "failure"),
)
"""Columns of the solver grid. `setting` is the length of the steps [s] or the tolerance;
`evaluations` has rejected steps in it, and is empty where they are not counted; errors are empty
for a failure, and `failure` for a success."""


@dataclass(frozen=True)
class WorkPrecision:
    """Result of a work-precision study of a scene."""

    scene: str
    seconds: float  # time span [s]
    ends: str  # why it ends before the scene's duration; empty where it does not
    reference: ReferenceSolution
    rows: DataFrame  # the solver grid, columns as in COLUMNS; settings from coarse to fine
    advice: StepAdvice  # as `scene show` prints it
    measured: tuple[float, float] | None
    """Error [rad] and wall time [s] of `simulate` with that advice; None where a limit stops it."""
    formulation: float | None
    """Largest difference of W_dot from the paper's equations along the reference, relative to the
    largest W_dot; None where it cannot be compared."""
    warnings: tuple[str, ...]  # contradictions

    @property
    def floor(self) -> float:
        """Smallest orientation error that is reported [rad]."""
        return ABOVE_REFERENCE * self.reference.own.orientation

    @property
    def rests(self) -> bool:
        """Whether nothing moves, so that every setting is right to rounding.

        So it is with scenes that a controller drives along a reference motion.
        """
        states = self.reference.states[:, :7]
        return bool(np.abs(states - states[0]).max() < ROUNDING)

    def best(self, target: float) -> Series[Any] | None:
        """Return the fastest setting with an orientation error of at most `target` [rad].

        A setting counts only if at least one finer setting of its method was tried and every one
        of them is as good: a coarse setting whose errors happen to cancel is no recommendation.
        """
        good: list[Any] = []
        if self.rests:
            return None
        for _, group in self.rows.groupby(["method", "kind"], sort=False):
            bad = np.flatnonzero(~(group[ERROR].astype(float).to_numpy() <= target))
            good += group.index[bad[-1] + 1 if len(bad) else 0 : -1].tolist()
        found = self.rows.loc[good].sort_values("wall_min_s", kind="stable")
        return None if found.empty else found.iloc[0]


def work_precision(
    scene: Scene, *, kind: str = EXTENDED, shown: bool = False, longest_s: float = LONGEST_RUN_S
) -> WorkPrecision:
    """Solve a scene with every method and setting and compare with the reference.

    The reference has numbers of a kind; progress is `shown` on the terminal; no finer settings are
    tried after a run that took longer than `longest_s`. Raises what the problem and its reference
    do.
    """
    problem = InitialValueProblem(scene)
    grid = solver_grid(problem)
    truth = solve_reference(problem, kind)
    rows: list[dict[str, Any]] = []
    best: dict[str, tuple[float, Array]] = {}  # by method: least error, and the last state
    for part in slices(len(grid), 1, f"{scene.name:<16}", shown):
        for row, end in refine(grid[part.start], problem, truth, longest_s):
            rows.append({"scene": scene.name, **row})
            found = row.get("final_orientation_rad", math.inf), end
            best[row["method"]] = min(best.get(row["method"], found), found, key=lambda x: x[0])
    zero = np.zeros((len(problem.times), 3))
    torques = zero if scene.torque is None else scene.torque.values(problem.times)
    along = zip(truth.states.astype(float), torques.tolist(), strict=True)
    difference, _ = compare_with_paper(scene, along)
    began = time.perf_counter()
    motion = simulate(scene, duration=problem.seconds, t_eval=problem.times)
    wall, measured = time.perf_counter() - began, None
    if len(motion) > problem.count:  # else a limit stops it before
        states = np.hstack([motion.quaternion, motion.body_rate])
        measured = problem.errors(states, truth.states)[1].orientation, wall
    return WorkPrecision(
        scene=scene.name,
        seconds=problem.seconds,
        ends=problem.ends,
        reference=truth,
        rows=data_frame(rows, COLUMNS),
        advice=step_advice(scene),
        measured=measured,
        formulation=difference,
        warnings=tuple(_warnings(problem, truth, best, difference)),
    )


def _warnings(
    problem: InitialValueProblem,
    truth: ReferenceSolution,
    best: dict[str, tuple[float, Array]],
    difference: float | None,
) -> Iterator[str]:
    if difference is not None and difference > SAME_EQUATIONS:
        yield f"the kernel differs from the paper's equations by {difference:.1e}"
    if problem.clamped:
        yield "the torques are clamped to the actuators' limit: no fixed steps are tried"
    best = {method: found for method, found in best.items() if found[0] < math.inf}
    for one, two in itertools.combinations(best, 2):
        (error, end), (other_error, other_end) = best[one], best[two]
        apart = problem.errors(end[None], other_end[None].astype(np.longdouble))[0].orientation
        least = min(error, other_error)
        if least > 100.0 * max(apart, 10.0 * truth.own.orientation, 1e-13):
            yield (
                f"{one} and {two} agree to {apart:.1e} rad, but are {least:.1e} "
                "rad off the reference: they do not solve what the reference solves"
            )
            return


class SolverSetting(NamedTuple):
    """One point of the grid."""

    method: str
    kind: str  # FIXED or TOLERANCE
    setting: float  # step [s] or tolerance
    solve: Callable[[], tuple[Array, int]]
    """Returns the states at the instants, and the evaluations of the right-hand side. Raises
    SstError, ArithmeticError or ValueError."""
    timed: Callable[[], object]  # does the same work with the least overhead


def solver_grid(problem: InitialValueProblem) -> list[Iterator[SolverSetting]]:
    """Return the settings by method and kind, each from coarse to fine."""
    found: list[Iterator[SolverSetting]] = []
    for method in METHODS.values():
        if not problem.clamped:  # fixed steps know no limit of torque
            compiled = numba_version() is not None
            machine = CompiledMethod(problem.system, method, compiled=compiled)
            found.append(map(partial(_fix_steps, problem, machine), _STEPS_PER_INTERVAL))
        if method is not RK4:  # its steps in a run are fixed
            found.append(map(partial(_adapt_steps, problem, method.name), _TOLERANCES))
    if not problem.kinked:
        found += [_list_collocation(problem, kind) for kind in (FIXED, TOLERANCE)]
    return found


def _fix_steps(problem: InitialValueProblem, machine: CompiledMethod, steps: int) -> SolverSetting:
    count, h = steps * problem.count, problem.interval / steps
    timed = partial(machine.step_fixed, 0.0, h, count, list(problem.start), problem.drive)

    def solve() -> tuple[Array, int]:
        return problem.run_steps(machine, steps), len(machine.method.a) * count

    return SolverSetting(machine.method.name, FIXED, h, solve, timed)


def _adapt_steps(problem: InitialValueProblem, method: str, tolerance: float) -> SolverSetting:
    simulation = problem.simulation(method, tolerance)
    run = partial(problem.run_simulation, simulation)

    def solve() -> tuple[Array, int]:
        before = simulation.evaluations
        return run(), simulation.evaluations - before

    return SolverSetting(method, TOLERANCE, tolerance, solve, run)


def _list_collocation(problem: InitialValueProblem, kind: str) -> Iterator[SolverSetting]:
    """Yield settings of Gauss collocation, with the steps that each tolerance chooses.

    A run of fixed steps is one of a motion that has been prepared. One for a tolerance searches
    for its steps, which solves the motion several times.
    """
    longest = math.inf
    for tolerance in (1e-2, 1e-3, *_TOLERANCES):
        make = partial(
            prepare, problem.scene, duration=problem.seconds, method=GAUSS, tolerance=tolerance
        )

        def solve(make: Callable[[], PreparedRun] = make) -> tuple[Array, int]:
            motion = make().run()
            dense = motion.at(problem.times)
            torque = [dense.torque] if problem.scene.lags else []
            unknown = np.full((len(dense), 1), np.nan)  # the work
            found = np.hstack([dense.quaternion, dense.body_rate, *torque, unknown])
            return found, motion.evaluations

        if kind == TOLERANCE:
            yield SolverSetting(GAUSS, kind, tolerance, solve, make)
            continue
        with contextlib.suppress(SstError):
            ready = make()
            step = ready.run().step
            if step < longest:
                longest = step
                yield SolverSetting(GAUSS, kind, step, solve, ready.run)


def refine(
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
        slower = SLOWER if problem.clamped and setting.kind == TOLERANCE else 1.0
        if (row["wall_min_s"] > longest_s * slower and number >= LEAST_SETTINGS) or below > 1:
            return


def _result(
    setting: SolverSetting, problem: InitialValueProblem, truth: ReferenceSolution
) -> tuple[dict[str, Any], Array]:
    """Run one setting: its row of the grid, and its last state, nan for a failure."""
    states, evaluations, failure = np.full((1, len(problem.start)), np.nan), None, ""
    walls: list[float] = []
    with np.errstate(all="ignore"):
        try:
            states, evaluations = setting.solve()
            while len(walls) < 3 or (sum(walls) < _REPEAT_S and len(walls) < _REPEATS):
                began = time.perf_counter()
                setting.timed()
                walls.append(time.perf_counter() - began)
                if walls[-1] > LONGEST_RUN_S:
                    break
        except (SstError, ArithmeticError, ValueError) as error:
            failure = str(error).splitlines()[0] if str(error) else "not finite"
            walls = []
    if not failure and not np.isfinite(states[:, :7]).all():
        failure = "not finite"
    row = {"method": setting.method, "kind": setting.kind, "setting": setting.setting}
    row |= {"evaluations": evaluations, "wall_min_s": min(walls, default=0.0)}
    row["wall_median_s"] = float(np.median(walls or [0.0]))
    if not failure:
        final, largest = problem.errors(states, truth.states)
        if not largest.orientation <= USELESS or not math.isfinite(largest.gamma_dot):
            failure = f"off by {largest.orientation:.1g} rad"
        else:
            row |= dict(zip(ERRORS, (*final, *largest), strict=True))
            energy, row["closure_residual"] = problem.residuals(states[-1])
            row["energy_residual_J"] = energy if math.isfinite(energy) else None
            row["below_floor"] = largest.orientation < ABOVE_REFERENCE * truth.own.orientation
    return row | {"failure": failure}, states[-1]
