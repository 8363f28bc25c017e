# SPDX-License-Identifier: Apache-2.0
"""Runs of an extreme case, and what they have to agree with.

The introduction of the page, in `extreme`, says what is run and compared.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import RunStopped, SstError
from sst_ros.integration.batch import Batch, whole_steps
from sst_ros.integration.batch_source import NOT_FINITE
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.compiled_method import CompiledMethod
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.yaml_document import values_of
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation
from sst_ros.state import NANOSECONDS, Vector3
from studies.control_loop import run_in_loop
from studies.extreme_cases import Case, apart

LOOSER = 1e-4
"""Tolerance at which the error estimate is checked where LOOSE resolves no error."""

FACTOR = 10.0
"""The error estimate must lie within this factor of the true error."""

ROUNDING = 1e-12
"""True errors below this [rad], or 100 times the estimate of the run at the default tolerance, are
not resolved: then the estimate must not be above FACTOR times that either."""

BATCH_TOLERANCE = 1e-10
"""Local error estimate of a step up to which the end is that of a simulation: its default."""

SAME_ORIENTATION, SAME_RATE = 1e-9, 1e-8
"""Differences allowed: angle [rad], and of body rates relative to the largest or 1 rad/s."""

_NO_EFFECT = ("name", "description", "provenance", "initial", "torque", "motion", "duration")
"""Sections of a scene that are given to a run, or have no effect on it."""


class CaseRun(NamedTuple):
    """A simulation at its end, or the refusal and the simulation at its last state."""

    simulation: Simulation | None
    error: SstError | None

    def same_as(self, other: CaseRun) -> bool:
        """Whether both ended in the same bits, or with the same error."""
        if self.simulation is None or other.simulation is None:
            return False
        ends = (self.simulation.state, str(self.error))
        return ends == (other.simulation.state, str(other.error))


class EstimateCheck(NamedTuple):
    """True error and estimate at a loose tolerance [rad], None without such a run; a verdict."""

    true: float | None
    estimate: float | None
    verdict: str
    holds: bool = True


@dataclass(frozen=True)
class CaseResult:
    """Result of a case; None for what was not run or has no value."""

    name: str
    group: str
    difficulty: str
    expected: str
    bound: float
    result: str  # what happened, in words
    deviation: float | None = None  # from the truth
    energy: float | None = None  # residual at the end relative to the energy
    closure: float | None = None  # largest abs(r_k . t_k) at the end
    estimate: float | None = None  # of the error of the orientation at the end [rad]
    loose_error: float | None = None  # true error at a loose tolerance [rad]
    loose_estimate: float | None = None  # its estimate [rad]
    check: str = ""  # what the estimate was found to be, or why it cannot be checked
    wall_s: float | None = None  # time of the interpreted run [s]
    compiled_s: float | None = None  # time of the compiled run, compilation included [s]
    same_bits: bool | None = None  # the compiled run ended in the same bits, or error
    run_loop: bool | None = None  # so did that through the loop of the node
    correct: bool = False  # the result is the truth, and the error estimate holds
    batch: str = ""  # what a batch was compared with; empty where it was not run

    @property
    def passed(self) -> bool:
        """The result is correct, and no run differs from the interpreted one."""
        return self.correct and self.same_bits is not False and self.run_loop is not False


def run(
    case: Case, *, compiled: bool = False, tolerance: float | None = None, looped: bool = False
) -> CaseRun:
    """Run a case, also through the tick loop of the node; refusals are results.

    A given tolerance allows steps of any length.
    """
    simulation = None
    try:
        simulation = Simulation(
            case.scene(), case.integrator, tolerance=tolerance or 1e-10, compiled=compiled,
            step_budget=WHOLE_MOTION_BUDGET,
        )  # fmt: skip
        if looped:
            run_in_loop(simulation, case.torque_at, case.period_ns, case.steps)
        elif not callable(case.torque) and tolerance is not None:
            simulation.step(case.torque, case.steps * case.period_ns)
        elif not callable(case.torque) and compiled:
            simulation.steps(case.torque, case.period_ns, case.steps)
        else:
            for _ in range(case.steps):
                simulation.step(case.torque_at(simulation), case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, with the tick loop, and with its compiled run."""
    jit = numba_version() is not None and (compiled or case.compiled_only)
    began = time.perf_counter()
    first = run(case, compiled=case.compiled_only and jit)
    clock = "compiled_s" if case.compiled_only else "wall_s"
    found: dict[str, Any] = {clock: time.perf_counter() - began}
    deviation, correct, result = _judge(case, first)
    check = estimate_check(case, first)
    remarks = [result]
    if first.simulation is not None:
        found |= _measure_end(first.simulation)
        if not case.compiled_only:
            found["run_loop"] = first.same_as(run(case, looped=True))
            remarks += [] if found["run_loop"] else ["the run loop differs"]
            if jit:
                began = time.perf_counter()
                found["same_bits"] = first.same_as(run(case, compiled=True))
                found["compiled_s"] = time.perf_counter() - began
                remarks += [] if found["same_bits"] else ["the compiled run differs"]
    remarks += [] if check.holds else [f"error estimate: {check.verdict}"]
    return CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, "; ".join(remarks),
        deviation=deviation, correct=correct and check.holds, loose_error=check.true,
        loose_estimate=check.estimate, check=check.verdict, **found,
    )  # fmt: skip


def _judge(case: Case, done: CaseRun) -> tuple[float | None, bool, str]:
    """Compare the end of a run with the truth: deviation, whether it is correct, and words."""
    simulation, error = done
    if error is not None:
        result = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        correct = type(error).__name__ == case.refusal
        if correct and case.stop_time is not None and isinstance(error, RunStopped):
            exact = case.stop_time()
            late = abs(error.time - exact)
            result += f" ({late:.1e} s off)"
            correct = late <= 1e-6 * exact + 1e-15
        return None, correct, result
    if simulation is None or case.deviation is None:
        return None, False, "finished"
    deviation = float(case.deviation(case, simulation))
    return deviation, deviation <= case.bound, "finished"


def _measure_end(simulation: Simulation) -> dict[str, float]:
    began = *initial_state(simulation.scene, simulation.geometry), 0.0, 0.0, 0.0
    energies = map(simulation.dynamics.total_energy, (simulation.sample[0], began))
    return {
        "energy": abs(simulation.energy_residual) / max(*map(abs, energies), 1e-300),
        "closure": simulation.closure_residual,
        "estimate": simulation.error_estimate,
    }


def estimate_check(case: Case, accurate: CaseRun) -> EstimateCheck:
    """Compare the error estimate with the true error, by the run at the default tolerance."""
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
    return unresolved or EstimateCheck(None, None, "there is no run at a loose tolerance", False)


def batch_groups(cases: Sequence[Case]) -> list[tuple[int, ...]]:
    """Return the numbers of the cases that can run as a batch, those of one batch together.

    Torques that read the simulation, starts that are refused, and runs of ten million steps cannot.
    """
    groups: dict[Any, list[int]] = {}
    for number, case in enumerate(cases):
        if case.feedback or case.compiled_only:
            continue
        try:
            scene = case.scene()
            initial_state(scene, Geometry.of(scene))
        except SstError:
            continue
        # Which terms a scene has, and its choices: all of it but the values of its numbers.
        terms = tuple((k, isinstance(v, str) and v) for k, v in leaves(values_of(scene)))
        groups.setdefault(terms, []).append(number)
    return [tuple(group) for group in groups.values()]


def run_batch(cases: Sequence[Case]) -> list[tuple[str, bool]]:
    """Run cases of the same terms as one batch; what was compared, and whether it agrees."""
    numbers = [dict(leaves(values_of(case.scene()))) for case in cases]
    varied = {
        key: [row[key] for row in numbers]
        for key, value in numbers[0].items()
        if any(row[key] != value for row in numbers)
    }
    batch = Batch(cases[0].scene(), DOP853, parameters=varied)
    return [compare_row(batch, row, case, len(cases)) for row, case in enumerate(cases)]


def leaves(section: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield key and value of the numbers and choices that act on the motion of a scene."""
    for name, value in section.items():
        if name in _NO_EFFECT:
            continue
        if isinstance(value, dict):
            yield from leaves(value, f"{path}{name}.")
        elif isinstance(value, list) and isinstance(value[0], dict):
            for i, entry in enumerate(value):
                yield from leaves(entry, f"{path}{name}[{i}].")
        else:
            yield f"{path}{name}", value


def compare_row(batch: Batch, row: int, case: Case, count: int) -> tuple[str, bool]:
    """Run a case as a row of a batch of `count`; what was compared, and whether it agrees."""
    scene, h = case.scene(), case.period_ns / NANOSECONDS
    y, code = np.zeros((len(batch.model.ode.state), 1)), np.zeros(1, dtype=np.int64)
    when, error = np.full(1, np.nan), np.zeros(1)
    y[:7, 0] = initial_state(scene, Geometry.of(scene))
    alone: list[float] = y[:, 0].tolist()
    spans: list[tuple[int, int, Vector3]]  # first step, number of steps, constant torque
    if callable(case.torque):
        spans = [(k, 1, case.torque(k, None)) for k in range(case.steps)]
    else:
        spans = [(0, case.steps, case.torque)]
    for first, steps, torque in spans:
        given = np.ascontiguousarray(batch.drives(torque, count)[:, [row]])
        batch.advance(first, steps, h, y, given, code, when, error, threads=1)
    # The step in which it ends is left out.
    done = int(whole_steps(when, h)[0]) if code[0] else case.steps
    own = CompiledMethod(ODE(Dynamics.of(scene)), DOP853, compiled=False)
    with np.errstate(all="ignore"):
        for first, steps, torque in spans:
            alone = own.step_fixed(0.0, h, max(0, min(steps, done - first)), alone, torque)
    if alone != y[:, 0].tolist():
        return "another end than fixed steps of its own", False
    if error[0] > BATCH_TOLERANCE or code[0] >= NOT_FINITE:
        return "bits", True
    simulation, ended = run(case)
    agree = False
    if code[0]:
        index = int(np.broadcast_to(batch.columns.geometry, count)[row])
        limit = batch.model.limits(batch.columns.geometries.of_rows(index))[int(code[0]) - 1]
        if isinstance(ended, RunStopped) and ended.reason == limit.reason:
            agree = abs(float(when[0]) - ended.time) <= h + 1e-12
    elif ended is None and simulation is not None:
        turned = angle_between(simulation.state.quaternion, y[:4, 0])
        rate = np.array(simulation.state.body_rate)
        faster = np.abs(rate - y[4:7, 0]).max() / max(1.0, np.abs(rate).max())
        agree = bool(turned < SAME_ORIENTATION and faster < SAME_RATE)
    return ("bits and end" if agree else "another end than the simulation"), agree
