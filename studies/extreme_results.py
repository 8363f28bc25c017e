# SPDX-License-Identifier: Apache-2.0
"""Evaluation of an extreme case against its truth, its other runs, and its error estimate.

Every case runs interpreted, one control period a call; through the run loop of the node; and
compiled, in as few calls as possible: all must end in the same bits. `extreme_batches` runs it as a
scenario of a batch. The error estimate is checked in a run at a loose tolerance, whose steps are as
long as that allows: its true error is its distance from the run at the default tolerance, which is
smaller by orders of magnitude.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import RunStopped
from sst_ros.integration.codegen import numba_version
from sst_ros.simulation.simulation import Simulation
from studies.extreme_cases import Case, CaseRun, run, run_through_loop
from studies.extreme_scenes import apart

LOOSER = 1e-4
"""Tolerance at which the error estimate is checked where LOOSE resolves no error."""

FACTOR = 10.0
"""The error estimate must lie within this factor of the true error."""

ROUNDING = 1e-12
"""True errors below this [rad], or 100 times the estimate of the run at the default tolerance, are
not resolved: then the estimate must not be above FACTOR times that either."""


@dataclass(frozen=True)
class EstimateCheck:
    """Error estimate against the true error.

    Attributes:
        true, estimate: at a loose tolerance [rad]; None where there is no such run.
        verdict: what was found, in words.
        holds: whether the estimate is as it should be.

    """

    true: float | None
    estimate: float | None
    verdict: str
    holds: bool = True


@dataclass(frozen=True)
class CaseResult:
    """Result of a case.

    Attributes:
        name, group, difficulty, expected, bound: of the case.
        result: what happened, in words.
        deviation: distance from the truth; None for a refusal.
        energy: energy residual at the end relative to the energy; None where no run began.
        closure: largest abs(r_k . t_k) at the end; None where no run began.
        estimate: error estimate of the orientation at the end [rad]; None where no run began.
        loose_error, loose_estimate: true error and error estimate [rad] at a loose tolerance; None
            where there is no such run.
        check: what the error estimate was found to be, or why it cannot be checked.
        wall_s, compiled_s: time of the interpreted and of the compiled run, compilation included
            [s]; None where it was not run.
        same_bits, run_loop: the compiled run, and that through the run loop, ended in the same bits
            or with the same error; None where it was not run.
        batch: what a batch was compared with; empty where it was not run.
        correct: the result is the truth, and the error estimate holds.

    """

    name: str
    group: str
    difficulty: str
    expected: str
    bound: float
    result: str
    deviation: float | None
    energy: float | None
    closure: float | None
    estimate: float | None
    loose_error: float | None
    loose_estimate: float | None
    check: str
    wall_s: float | None
    compiled_s: float | None
    same_bits: bool | None
    run_loop: bool | None
    correct: bool
    batch: str = ""

    @property
    def passed(self) -> bool:
        """The result is correct, and no run differs from the interpreted one."""
        return self.correct and self.same_bits is not False and self.run_loop is not False


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, with the run loop, and with its compiled run."""
    jit = numba_version() is not None and (compiled or case.compiled_only)
    first, first_s = _timed(partial(run, case, compiled=case.compiled_only and jit))
    simulation, error = first.simulation, first.error
    compiled_s = first_s if case.compiled_only else None
    same_bits = run_loop = None
    deviation, result, correct = None, "finished", False
    if error is not None:
        result = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        correct = type(error).__name__ == case.refusal
        if correct and case.stop_time is not None and isinstance(error, RunStopped):
            exact = case.stop_time()
            late = abs(error.time - exact)
            result += f" ({late:.1e} s off)"
            correct = late <= 1e-6 * exact + 1e-15
    elif simulation is not None and case.deviation is not None:
        deviation = float(case.deviation(simulation))
        correct = deviation <= case.bound
    energy = closure = estimate = None
    if simulation is not None:
        now, start = simulation.state, initial_state(simulation.scene, simulation.geometry)
        ends = (_stored(simulation, y) for y in ((*now.quaternion, *now.body_rate), start))
        energy = abs(simulation.energy_residual) / max(*map(abs, ends), 1e-300)
        closure, estimate = simulation.closure_residual, simulation.error_estimate
        if not case.compiled_only:
            run_loop = _same(first, run_through_loop(case))
            result += "" if run_loop else "; the run loop differs"
            if jit:
                second, compiled_s = _timed(partial(run, case, compiled=True))
                same_bits = _same(first, second)
                result += "" if same_bits else "; the compiled run differs"
    check = estimate_check(case, first)
    if not check.holds:
        result += f"; error estimate: {check.verdict}"
    return CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, result, deviation,
        energy, closure, estimate, check.true, check.estimate, check.verdict,
        None if case.compiled_only else first_s, compiled_s, same_bits, run_loop,
        correct and check.holds,
    )  # fmt: skip


def estimate_check(case: Case, accurate: CaseRun) -> EstimateCheck:
    """Compare the error estimate with the true error.

    Args:
        case: the case.
        accurate: its run at the default tolerance.

    """
    if accurate.error is not None or accurate.simulation is None:
        held = "its time is held to theory" if case.stop_time else "there is no motion"
        return EstimateCheck(None, None, f"none: the run is refused, {held}")
    if case.loose is None:
        return EstimateCheck(None, None, f"none: {case.estimate}")
    unresolved = None
    for tolerance in dict.fromkeys((case.loose, max(case.loose, LOOSER))):
        loose = run(case, tolerance=tolerance).simulation
        if loose is None or loose.time_ns != accurate.simulation.time_ns:
            break
        true, estimate = apart(loose, accurate.simulation), loose.error_estimate
        resolved = max(ROUNDING, 100.0 * accurate.simulation.error_estimate)
        if true >= resolved:
            holds = true / FACTOR <= estimate <= FACTOR * true
            words = f"{estimate / true:.2g} of the true error at a tolerance of {tolerance:g}"
            words += f"; {case.estimate}" if case.estimate else ""
            return EstimateCheck(true, estimate, words, holds)
        if true == 0.0 == estimate:
            return EstimateCheck(0.0, 0.0, "both are zero: it rests")
        words = f"true error below {resolved:.0e} rad, which is not resolved; so is the estimate"
        holds = estimate <= FACTOR * resolved
        unresolved = unresolved or EstimateCheck(true, estimate, words, holds)
    none = EstimateCheck(None, None, "there is no run at a loose tolerance", holds=False)
    return unresolved or none


def _same(one: CaseRun, other: CaseRun) -> bool:
    return (
        one.simulation is not None
        and other.simulation is not None
        and one.simulation.state == other.simulation.state
        and str(one.error) == str(other.error)
    )


def _timed(call: Callable[[], CaseRun]) -> tuple[CaseRun, float]:
    began = time.perf_counter()
    done = call()
    return done, time.perf_counter() - began


def _stored(simulation: Simulation, y: Sequence[float]) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))
