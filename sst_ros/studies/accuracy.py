# SPDX-License-Identifier: Apache-2.0
"""How accurate a scene is solved and what it costs: a work-precision study."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.errors import SingularConfiguration, SstError
from sst_ros.integration.codegen import numba_version
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array
from sst_ros.progress import slices
from sst_ros.report import formulation
from sst_ros.scene.scene import Scene
from sst_ros.studies.high_precision import EXTENDED
from sst_ros.studies.solver_grid import TOLERANCE, Way, ladders
from sst_ros.studies.work_precision import Error, Reference, Trial

ABOVE_REFERENCE = 100.0
"""Errors are told only if they are so many times larger than the reference's own."""

USELESS = 0.1
"""An orientation that is off by more than this [rad] is a failure."""

SOUND = 1e-10
"""The kernel and the paper's equations must agree to this part."""

ROUNDING = 2e-14
"""Finer steps cannot be expected to give less than this [rad]."""

LONGEST_RUN_S = 0.4
"""No finer steps are tried after a run that took longer than this [s]."""

SLOWER = 5.0
"""`Simulation` under torques that are functions is plain Python and may take so much longer."""

_REPEAT_S, _REPEATS = 0.15, 15


@dataclass(frozen=True)
class Row:
    """One way to solve the run, and what came of it.

    Attributes:
        method: name of the method.
        kind: FIXED or TOLERANCE.
        setting: length of the steps [s], or the tolerance.
        evaluations: of the right-hand side, rejected steps included; None where nobody counts.
        wall_s: shortest and median wall time of the run [s].
        final, largest: errors at the end, and the largest over the run; None for a failure.
        energy, closure: residuals at the end: energy [J], None where work is not kept, and
            abs(r_k . t_k).
        failure: what went wrong; empty where nothing did.
        end: last state; nan for a failure.

    """

    method: str
    kind: str
    setting: float
    evaluations: int | None
    wall_s: tuple[float, float]
    final: Error | None
    largest: Error | None
    energy: float | None
    closure: float | None
    failure: str
    end: Array


@dataclass(frozen=True)
class Study:
    """Everything that was found out about a scene.

    Attributes:
        scene: its name.
        seconds: time over which it was compared [s].
        ends: why the run ends before its duration; empty where it does not.
        compiled: by numba.
        reference: what was compared with.
        rows: what was tried.
        formulation: largest difference of W_dot to the paper's equations along the reference, as
            a part of the largest W_dot; None where it cannot be compared.
        warnings: what does not fit together.

    """

    scene: str
    seconds: float
    ends: str
    compiled: bool
    reference: Reference
    rows: tuple[Row, ...]
    formulation: float | None
    warnings: tuple[str, ...]

    @property
    def floor(self) -> float:
        """Smallest error of the orientation that can be told [rad]."""
        return ABOVE_REFERENCE * self.reference.own.orientation

    def best(self, target: float) -> Row | None:
        """Return the fastest row whose orientation is off by no more than `target` [rad]."""
        good = [row for row in self.rows if row.largest and row.largest.orientation <= target]
        return min(good, key=lambda row: row.wall_s[0], default=None)


def study(
    scene: Scene,
    *,
    solved: Scene | None = None,
    kind: str = EXTENDED,
    compiled: bool = True,
    shown: bool = False,
    longest_s: float = LONGEST_RUN_S,
) -> Study:
    """Solve a scene in every way and compare with the reference.

    Args:
        scene: what the reference solves.
        solved: what the methods solve, if it is another scene: the study must see the difference.
        kind: arithmetic of the reference, precise.EXTENDED or precise.MPMATH.
        compiled: by numba, where it is installed.
        shown: draw a bar on the terminal.
        longest_s: no finer steps are tried after a run that took longer than this [s].

    Raises:
        AssemblyError: the initial gamma has no unique admissible assembly.
        InputError: the scene cannot start, or mpmath is asked for and not installed.

    """
    compiled = compiled and numba_version() is not None
    target = Trial(scene)
    trial = target if solved is None else Trial(solved, like=target)
    ways = ladders(trial, compiled)
    rows: list[Row] = []
    truth: Reference | None = None
    for part in slices(len(ways) + 1, 1, f"{scene.name:<16}", shown):
        if truth is None:
            truth = target.reference(kind, compiled=compiled)
        else:
            rows += _climb(ways[part.start - 1], trial, truth, longest_s)
    assert truth is not None
    difference = _formulation(target, truth)
    return Study(
        scene.name, target.seconds, target.ends, compiled, truth, tuple(rows), difference,
        tuple(_warnings(trial, truth, rows, difference)),
    )  # fmt: skip


def _climb(
    ladder: Iterator[Way], trial: Trial, truth: Reference, longest_s: float
) -> Iterator[Row]:
    """Go from coarse to fine until it takes long or nothing more can be told."""
    beyond, floor = 0, ABOVE_REFERENCE * truth.own.orientation
    for way in ladder:
        row = _row(way, trial, truth)
        yield row
        if row.largest:
            beyond += row.largest.orientation < max(floor, ROUNDING)
        slow = SLOWER if trial.kinked and way.kind == TOLERANCE else 1.0
        if row.wall_s[0] > longest_s * slow or beyond > 1:
            return


def _row(way: Way, trial: Trial, truth: Reference) -> Row:
    states, evaluations, failure = np.full((1, len(trial.start)), np.nan), None, ""
    wall = (0.0, 0.0)
    with np.errstate(all="ignore"):
        try:
            states, evaluations = way.solve()
            wall = _timed(way.timed)
        except (SstError, ArithmeticError, ValueError) as error:
            failure = str(error).splitlines()[0] if str(error) else "not finite"
    if not failure and not np.isfinite(states[:, :7]).all():
        failure = "not finite"
    final = largest = energy = closure = None
    if not failure:
        final, largest = trial.errors(states, truth.states)
        if not largest.orientation <= USELESS or not math.isfinite(largest.gamma_dot):
            failure, final, largest = f"off by {largest.orientation:.1g} rad", None, None
        else:
            residual, closure = trial.residuals(states[-1])
            energy = residual if math.isfinite(residual) else None
    return Row(way.method, way.kind, way.setting, evaluations, wall, final, largest, energy,
               closure, failure, states[-1])  # fmt: skip


def _timed(run: Callable[[], object]) -> tuple[float, float]:
    walls: list[float] = []
    while len(walls) < 3 or (sum(walls) < _REPEAT_S and len(walls) < _REPEATS):
        began = time.perf_counter()
        run()
        walls.append(time.perf_counter() - began)
        if walls[-1] > LONGEST_RUN_S:
            break
    return min(walls), float(np.median(walls))


def _formulation(trial: Trial, truth: Reference) -> float | None:
    """Compare the kernel with the paper's equations along the reference; loads are left out."""
    bare = Scene(**{name: getattr(trial.scene, name) for name in formulation.PAPER})
    mechanism, model = virtual_work.Mechanism.of(bare), kernel.model_of(bare)
    apart, sizes = [], []
    for k, state in enumerate(truth.states[:, :7].astype(float).tolist()):
        now = trial.torque
        torque = now(k * trial.interval) if callable(now) else now
        try:
            paper = formulation.of_the_paper(mechanism, tuple(state), np.array(torque))
        except (SingularConfiguration, np.linalg.LinAlgError):
            continue
        ours = np.array(kernel.derivative(model, tuple(state), torque)[4:7])
        apart.append(float(np.linalg.norm(ours - paper)))
        sizes.append(float(np.linalg.norm(paper)))
    return max(apart) / max(sizes) if sizes and max(sizes) > 0.0 else None


def _warnings(
    trial: Trial, truth: Reference, rows: list[Row], difference: float | None
) -> Iterator[str]:
    if difference is not None and difference > SOUND:
        yield f"the kernel differs from the paper's equations by {difference:.1e}"
    if trial.clamped:
        yield "the torques are clamped to the actuators' limit: no fixed steps are tried"
    best: dict[str, Row] = {}
    for row in rows:
        if row.final and (row.method not in best or _error(row) < _error(best[row.method])):
            best[row.method] = row
    for one, other in itertools.combinations(best.values(), 2):
        pair = np.stack([one.end, other.end])[:, :7]
        apart = trial.errors(pair[:1], pair[1:].astype(np.longdouble))[0].orientation
        least = min(_error(one), _error(other))
        if least > 100.0 * max(apart, 10.0 * truth.own.orientation, 1e-13):
            yield (
                f"{one.method} and {other.method} agree to {apart:.1e} rad, but are {least:.1e} "
                "rad off the reference: they do not solve what the reference solves"
            )
            return


def _error(row: Row) -> float:
    return row.final.orientation if row.final else math.inf
