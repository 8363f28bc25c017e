# SPDX-License-Identifier: Apache-2.0
"""Work-precision study: the error of every method and setting on a scene, and what it costs."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.virtual_work_derivative import body_acceleration
from sst_ros.errors import SingularConfiguration, SstError
from sst_ros.integration.codegen import numba_version
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array
from sst_ros.progress import slices
from sst_ros.report import formulation
from sst_ros.scene.scene import Scene
from sst_ros.studies.high_precision import EXTENDED
from sst_ros.studies.initial_value_problem import InitialValueProblem, StateError
from sst_ros.studies.reference_solution import ReferenceSolution, solve_reference
from sst_ros.studies.solver_grid import TOLERANCE, SolverSetting, solver_grid
from sst_ros.studies.step_advice import StepAdvice, step_advice

ABOVE_REFERENCE = 100.0
"""Errors are reported only if they are so many times larger than the reference's own."""

USELESS = 0.1
"""An orientation error above this [rad] is a failure."""

SAME_EQUATIONS = 1e-10
"""Kernel and the paper's equations must agree to this part."""

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


@dataclass(frozen=True)
class SolverResult:
    """One point of the solver grid.

    Attributes:
        method: name of the method.
        kind: FIXED or TOLERANCE.
        setting: length of the steps [s], or the tolerance.
        evaluations: of the right-hand side, rejected steps included; None where not counted.
        wall_s: shortest and median wall time of the run [s].
        final, largest: errors at the end, and the largest over the run; None for a failure.
        energy, closure: residuals at the end: energy [J], None where work is not integrated, and
            abs(r_k . t_k).
        failure: why it failed; empty where it did not.
        end: last state; nan for a failure.

    """

    method: str
    kind: str
    setting: float
    evaluations: int | None
    wall_s: tuple[float, float]
    final: StateError | None
    largest: StateError | None
    energy: float | None
    closure: float | None
    failure: str
    end: Array

    @property
    def error(self) -> float:
        """Largest error of the orientation [rad]; infinite for a failure."""
        return self.largest.orientation if self.largest else math.inf


@dataclass(frozen=True)
class WorkPrecision:
    """Result of a work-precision study of a scene.

    Attributes:
        scene: its name.
        seconds: time span of the comparison [s].
        ends: why the span ends before the scene's duration; empty where it does not.
        compiled: by numba.
        reference: the reference solution.
        rows: the solver grid.
        advice: what `step_advice` recommends, as `scene show` prints it.
        measured: error [rad] and wall time [s] of `Simulation` with that advice; None where the
            scene's torques allow no such run.
        formulation: largest difference of W_dot from the paper's equations along the reference,
            relative to the largest W_dot; None where it cannot be compared.
        warnings: contradictions.

    """

    scene: str
    seconds: float
    ends: str
    compiled: bool
    reference: ReferenceSolution
    rows: tuple[SolverResult, ...]
    advice: StepAdvice
    measured: tuple[float, float] | None
    formulation: float | None
    warnings: tuple[str, ...]

    @property
    def floor(self) -> float:
        """Smallest orientation error that is reported [rad]."""
        return ABOVE_REFERENCE * self.reference.own.orientation

    def best(self, target: float) -> SolverResult | None:
        """Return the fastest setting with an orientation error of at most `target` [rad].

        A setting counts only if at least one finer setting of its method was tried and every one
        of them is as good: a coarse setting whose errors happen to cancel is no recommendation.
        """
        good: list[SolverResult] = []
        for _, group in itertools.groupby(self.rows, key=lambda row: (row.method, row.kind)):
            fine_first = list(group)[::-1]
            good += list(itertools.takewhile(lambda row: row.error <= target, fine_first))[1:]
        return min(good, key=lambda row: row.wall_s[0], default=None)


def work_precision(
    scene: Scene,
    *,
    solved: Scene | None = None,
    kind: str = EXTENDED,
    compiled: bool = True,
    shown: bool = False,
    longest_s: float = LONGEST_RUN_S,
) -> WorkPrecision:
    """Solve a scene with every method and setting and compare with the reference.

    Args:
        scene: what the reference solves.
        solved: what the methods solve, if it is another scene: the study must see the difference.
        kind: arithmetic of the reference, high_precision.EXTENDED or MPMATH.
        compiled: by numba, where it is installed.
        shown: draw a progress bar on the terminal.
        longest_s: no finer settings are tried after a run that took longer than this [s].

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the scene cannot start, or mpmath is asked for and not installed.

    """
    compiled = compiled and numba_version() is not None
    target = InitialValueProblem(scene)
    problem = target if solved is None else InitialValueProblem(solved, like=target)
    grid = solver_grid(problem, compiled)
    rows: list[SolverResult] = []
    truth: ReferenceSolution | None = None
    for part in slices(len(grid) + 1, 1, f"{scene.name:<16}", shown):
        if truth is None:
            truth = solve_reference(target, kind, compiled=compiled)
        else:
            rows += _refined(grid[part.start - 1], problem, truth, longest_s)
    assert truth is not None
    difference = _formulation(target, truth)
    advice = step_advice(scene)
    return WorkPrecision(
        scene.name, target.seconds, target.ends, compiled, truth, tuple(rows), advice,
        _measured(problem, truth, advice), difference,
        tuple(_warnings(problem, truth, rows, difference)),
    )  # fmt: skip


def _refined(
    settings: Iterator[SolverSetting],
    problem: InitialValueProblem,
    truth: ReferenceSolution,
    longest_s: float,
) -> Iterator[SolverResult]:
    """Go from coarse to fine until a run takes long or two errors lie below the floor."""
    below, floor = 0, ABOVE_REFERENCE * truth.own.orientation
    for number, setting in enumerate(settings, start=1):
        row = _result(setting, problem, truth)
        yield row
        below += row.error < max(floor, ROUNDING)
        slower = SLOWER if problem.kinked and setting.kind == TOLERANCE else 1.0
        if (row.wall_s[0] > longest_s * slower and number >= LEAST_SETTINGS) or below > 1:
            return


def _result(
    setting: SolverSetting, problem: InitialValueProblem, truth: ReferenceSolution
) -> SolverResult:
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
    final = largest = energy = closure = None
    if not failure:
        final, largest = problem.errors(states, truth.states)
        if not largest.orientation <= USELESS or not math.isfinite(largest.gamma_dot):
            failure, final, largest = f"off by {largest.orientation:.1g} rad", None, None
        else:
            residual, closure = problem.residuals(states[-1])
            energy = residual if math.isfinite(residual) else None
    return SolverResult(setting.method, setting.kind, setting.setting, evaluations, wall, final,
                        largest, energy, closure, failure, states[-1])  # fmt: skip


def _timed(run: Callable[[], object]) -> tuple[float, float]:
    walls: list[float] = []
    while len(walls) < 3 or (sum(walls) < _REPEAT_S and len(walls) < _REPEATS):
        began = time.perf_counter()
        run()
        walls.append(time.perf_counter() - began)
        if walls[-1] > LONGEST_RUN_S:
            break
    return min(walls), float(np.median(walls))


def _measured(
    problem: InitialValueProblem, truth: ReferenceSolution, advice: StepAdvice
) -> tuple[float, float] | None:
    """Run `Simulation` as advised; implicit methods take no torques that are functions of time."""
    if advice.step is None or (advice.stiff and callable(problem.torque)):
        return None
    began = time.perf_counter()
    try:
        periods = math.ceil(problem.interval / advice.step * (1.0 - 1e-9))
        states = problem.simulated(advice.method, advice.tolerance, periods)
    except SstError:
        return None
    return problem.errors(states, truth.states)[1].orientation, time.perf_counter() - began


def _formulation(problem: InitialValueProblem, truth: ReferenceSolution) -> float | None:
    """Compare the kernel with the paper's equations along the reference; loads are left out."""
    bare = Scene(**{name: getattr(problem.scene, name) for name in formulation.PAPER})
    mechanism, model = virtual_work.Mechanism.of(bare), kernel.model_of(bare)
    differences, sizes = [], []
    for k, state in enumerate(truth.states[:, :7].astype(float).tolist()):
        given = problem.torque
        torque = given(k * problem.interval) if callable(given) else given
        try:
            paper, _ = body_acceleration(mechanism, state, torque)
        except (SingularConfiguration, np.linalg.LinAlgError):
            continue
        ours = np.array(kernel.derivative(model, tuple(state), torque)[4:7])
        differences.append(float(np.linalg.norm(ours - paper)))
        sizes.append(float(np.linalg.norm(paper)))
    return max(differences) / max(sizes) if sizes and max(sizes) > 0.0 else None


def _warnings(
    problem: InitialValueProblem,
    truth: ReferenceSolution,
    rows: list[SolverResult],
    difference: float | None,
) -> Iterator[str]:
    if difference is not None and difference > SAME_EQUATIONS:
        yield f"the kernel differs from the paper's equations by {difference:.1e}"
    if problem.clamped:
        yield "the torques are clamped to the actuators' limit: no fixed steps are tried"
    best: dict[str, tuple[float, SolverResult]] = {}
    for row in rows:
        error = row.final.orientation if row.final else math.inf
        if row.final and error < best.get(row.method, (math.inf,))[0]:
            best[row.method] = error, row
    for (error, one), (other_error, other) in itertools.combinations(best.values(), 2):
        pair = np.stack([one.end, other.end])[:, :7]
        apart = problem.errors(pair[:1], pair[1:].astype(np.longdouble))[0].orientation
        least = min(error, other_error)
        if least > 100.0 * max(apart, 10.0 * truth.own.orientation, 1e-13):
            yield (
                f"{one.method} and {other.method} agree to {apart:.1e} rad, but are {least:.1e} "
                "rad off the reference: they do not solve what the reference solves"
            )
            return
