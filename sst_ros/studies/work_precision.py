# SPDX-License-Identifier: Apache-2.0
"""Work-precision study: error and computing time of every method and setting on a scene."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sst_ros.errors import SstError
from sst_ros.host.output import slices
from sst_ros.integration.codegen import numba_version
from sst_ros.mechanism.geometry import Array
from sst_ros.report import states
from sst_ros.report.results import table
from sst_ros.scene.scene import Scene
from sst_ros.studies.initial_value_problem import InitialValueProblem
from sst_ros.studies.reference_solution import EXTENDED, ReferenceSolution, solve_reference
from sst_ros.studies.solver_grid import (
    ABOVE_REFERENCE,
    COLUMNS,
    ERROR,
    LONGEST_RUN_S,
    ROUNDING,
    refined,
    solver_grid,
)
from sst_ros.studies.step_advice import StepAdvice, step_advice

if TYPE_CHECKING:
    from pandas import DataFrame, Series

SAME_EQUATIONS = 1e-10
"""Kernel and the paper's equations must agree to this part."""


@dataclass(frozen=True)
class WorkPrecision:
    """Result of a work-precision study of a scene.

    Attributes:
        scene: its name.
        seconds: time span of the comparison [s].
        ends: why the span ends before the scene's duration; empty where it does not.
        compiled: by numba.
        reference: the reference solution.
        rows: the solver grid, columns as in COLUMNS; settings of a method from coarse to fine.
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
    rows: DataFrame
    advice: StepAdvice
    measured: tuple[float, float] | None
    formulation: float | None
    warnings: tuple[str, ...]

    @property
    def floor(self) -> float:
        """Smallest orientation error that is reported [rad]."""
        return ABOVE_REFERENCE * self.reference.own.orientation

    @property
    def rests(self) -> bool:
        """Whether nothing moves, so that every setting is right to rounding.

        So it is with scenes that a controller drives along a reference motion.
        """
        errors = self.rows[ERROR].astype(float)
        return bool((errors < ROUNDING).all())

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
        kind: arithmetic of the reference, reference_solution.EXTENDED or MPMATH.
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
    truth = solve_reference(target, kind, compiled=compiled)
    rows: list[dict[str, Any]] = []
    ends: list[Array] = []
    for part in slices(len(grid), 1, f"{scene.name:<16}", shown):
        for row, end in refined(grid[part.start], problem, truth, longest_s):
            rows.append({"scene": scene.name, **row})
            ends.append(end)
    instants = (k * target.interval for k in range(len(truth.states)))
    torques = (target.torque(t) if callable(target.torque) else target.torque for t in instants)
    along = zip(truth.states.astype(float), torques, strict=True)
    difference, _ = states.compare_with_paper(scene, along)
    advice = step_advice(scene)
    return WorkPrecision(
        scene.name, target.seconds, target.ends, compiled, truth, table(rows, COLUMNS), advice,
        _measured(problem, truth, advice), difference,
        tuple(_warnings(problem, truth, rows, ends, difference)),
    )  # fmt: skip


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


def _warnings(
    problem: InitialValueProblem,
    truth: ReferenceSolution,
    rows: Sequence[dict[str, Any]],
    ends: Sequence[Array],
    difference: float | None,
) -> Iterator[str]:
    if difference is not None and difference > SAME_EQUATIONS:
        yield f"the kernel differs from the paper's equations by {difference:.1e}"
    if problem.clamped:
        yield "the torques are clamped to the actuators' limit: no fixed steps are tried"
    best: dict[str, tuple[float, Array]] = {}
    for row, end in zip(rows, ends, strict=True):
        error = row.get("final_orientation_rad", math.inf)
        if error < best.get(row["method"], (math.inf,))[0]:
            best[row["method"]] = error, end
    for (one, (error, end)), (two, (other_error, other_end)) in itertools.combinations(
        best.items(), 2
    ):
        pair = np.stack([end, other_end])[:, :7]
        apart = problem.errors(pair[:1], pair[1:].astype(np.longdouble))[0].orientation
        least = min(error, other_error)
        if least > 100.0 * max(apart, 10.0 * truth.own.orientation, 1e-13):
            yield (
                f"{one} and {two} agree to {apart:.1e} rad, but are {least:.1e} "
                "rad off the reference: they do not solve what the reference solves"
            )
            return
