# SPDX-License-Identifier: Apache-2.0
"""Runs of an extreme case, and what they have to agree with.

A case runs interpreted, one control period a call; through the tick loop of the simulator node; and
compiled, in as few calls as possible: all must end in the same bits, and as the truth says.
Its error estimate is checked at a loose tolerance, where the true error is the distance from the
run at the default tolerance. Cases whose scenes have the same terms are scenarios of one batch: it
has the bits of fixed steps of each scene alone, and where its local error estimate is as small as
that of a simulation, the end of the simulation, or the same limit within a step of the same time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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
"""Differences of quaternions, and of body rates relative to the largest or 1 rad/s, allowed."""

_NO_EFFECT = ("name", "description", "provenance", "initial", "torque", "motion", "duration")
"""Sections of a scene that are given to a run, or have no effect on it."""


@dataclass(frozen=True)
class CaseRun:
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


def run(case: Case, *, compiled: bool = False, tolerance: float | None = None) -> CaseRun:
    """Run a case; refusals are results. A given tolerance allows steps of any length."""
    simulation = None
    try:
        simulation = Simulation(
            case.scene(), case.integrator, tolerance=tolerance or 1e-10, compiled=compiled,
            step_budget=WHOLE_MOTION_BUDGET,
        )  # fmt: skip
        if not callable(case.torque) and tolerance is not None:
            simulation.step(case.torque, case.steps * case.period_ns)
        elif not callable(case.torque) and compiled:
            simulation.steps(case.torque, case.period_ns, case.steps)
        else:
            for _ in range(case.steps):
                simulation.step(case.torque_at(simulation), case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def run_through_loop(case: Case) -> CaseRun:
    """Run a case through the tick loop of the node, interpreted."""
    simulation = Simulation(case.scene(), case.integrator, step_budget=WHOLE_MOTION_BUDGET)
    try:
        run_in_loop(simulation, case.torque_at, case.period_ns, case.steps)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, with the tick loop, and with its compiled run."""
    jit = numba_version() is not None and (compiled or case.compiled_only)
    began = time.perf_counter()
    first = run(case, compiled=case.compiled_only and jit)
    first_s = time.perf_counter() - began
    check = estimate_check(case, first)
    found = CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, "finished",
        loose_error=check.true, loose_estimate=check.estimate, check=check.verdict,
        wall_s=None if case.compiled_only else first_s,
        compiled_s=first_s if case.compiled_only else None,
    )  # fmt: skip
    found = _judge(found, case, first)
    remarks = []
    if first.simulation is not None and not case.compiled_only:
        found = replace(found, run_loop=first.same_as(run_through_loop(case)))
        remarks += [] if found.run_loop else ["the run loop differs"]
        if jit:
            began = time.perf_counter()
            same = first.same_as(run(case, compiled=True))
            found = replace(found, compiled_s=time.perf_counter() - began, same_bits=same)
            remarks += [] if found.same_bits else ["the compiled run differs"]
    remarks += [] if check.holds else [f"error estimate: {check.verdict}"]
    result = "; ".join([found.result, *remarks])
    return replace(found, result=result, correct=found.correct and check.holds)


def _judge(found: CaseResult, case: Case, done: CaseRun) -> CaseResult:
    """Compare the end of a run with the truth."""
    simulation, error = done.simulation, done.error
    if simulation is not None:
        now, began = simulation.state, initial_state(simulation.scene, simulation.geometry)
        ends = (_stored(simulation, y) for y in ((*now.quaternion, *now.body_rate), began))
        energy = abs(simulation.energy_residual) / max(*map(abs, ends), 1e-300)
        found = replace(found, energy=energy, closure=simulation.closure_residual,
                        estimate=simulation.error_estimate)  # fmt: skip
    if error is not None:
        result = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        correct = type(error).__name__ == case.refusal
        if correct and case.stop_time is not None and isinstance(error, RunStopped):
            exact = case.stop_time()
            late = abs(error.time - exact)
            result += f" ({late:.1e} s off)"
            correct = late <= 1e-6 * exact + 1e-15
        return replace(found, result=result, correct=correct)
    if simulation is None or case.deviation is None:
        return found
    deviation = float(case.deviation(case, simulation))
    return replace(found, deviation=deviation, correct=deviation <= case.bound)


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
    none = EstimateCheck(None, None, "there is no run at a loose tolerance", holds=False)
    return unresolved or none


def _stored(simulation: Simulation, y: Sequence[float]) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))


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
    for first, steps, torque in _spans(case):
        given = np.ascontiguousarray(batch.drives(torque, count)[:, [row]])
        batch.advance(first, steps, h, y, given, code, when, error, threads=1)
    done = case.steps
    if code[0]:  # the step in which it ends is left out
        done = int(whole_steps(when, h)[0])
    own = CompiledMethod(ODE(Dynamics.of(scene)), DOP853, compiled=False)
    with np.errstate(all="ignore"):
        for first, steps, torque in _spans(case):
            alone = own.step_fixed(0.0, h, max(0, min(steps, done - first)), alone, torque)
    if alone != y[:, 0].tolist():
        return "another end than fixed steps of its own", False
    if error[0] > BATCH_TOLERANCE or code[0] >= NOT_FINITE:
        return "bits", True
    reason, stop = "", float(when[0])
    if code[0]:
        index = int(np.broadcast_to(batch.columns.geometry, count)[row])
        limits = batch.model.limits(batch.columns.geometries.of_rows(index))
        reason = limits[int(code[0]) - 1].reason
    agree = _agree(run(case), y[:7, 0].tolist(), reason, stop, h)
    return ("bits and end" if agree else "another end than the simulation"), agree


def _spans(case: Case) -> Iterator[tuple[int, int, Vector3]]:
    """Yield first step, number of steps and torque of the spans of constant torque."""
    if callable(case.torque):
        for k in range(case.steps):
            yield k, 1, case.torque(k, None)
    else:
        yield 0, case.steps, case.torque


def _agree(direct: CaseRun, y: list[float], reason: str, stop: float, h: float) -> bool:
    """Whether a simulation ends as a scenario does that ended in `y`, or at a limit."""
    if reason or direct.error is not None or direct.simulation is None:
        ended = direct.error
        return (
            isinstance(ended, RunStopped)
            and ended.reason == reason
            and abs(stop - ended.time) <= h + 1e-12
        )
    state = direct.simulation.state
    q, rate = np.array(state.quaternion), np.array(state.body_rate)
    turned = min(np.abs(q - y[:4]).max(), np.abs(q + y[:4]).max())
    return bool(
        turned < SAME_ORIENTATION
        and np.abs(rate - y[4:]).max() < SAME_RATE * max(1.0, np.abs(rate).max())
    )
