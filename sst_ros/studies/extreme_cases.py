# SPDX-License-Identifier: Apache-2.0
"""A stiff or extreme case: what is run, the truth, and how its result is evaluated.

Every case runs interpreted, one control period a call, and compiled, in as few calls as possible;
both must end in the same bits. Where there is an error to resolve, its estimate is compared with it
in a third run at the tolerance LOOSE whose steps are as long as that allows: its true error is its
distance from the run at the default tolerance, which is smaller by orders of magnitude.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import RunStopped, SstError
from sst_ros.integration.codegen import numba_version
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation
from sst_ros.studies.extreme_scenes import Triple, apart

Deviation = Callable[[Simulation], float]

LOOSE = 1e-6
"""Tolerance of the run whose error estimate is checked."""

FACTOR = 10.0
"""The error estimate must lie within this factor of the true error."""

WIDER_FACTOR = 30.0
"""The factor of a case that states why its estimate is no better."""

ROUNDING = 1e-12
"""True errors below this [rad], or 100 times the estimate of the run at the default tolerance, are
not resolved."""


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: short name.
        expected: the truth and its reason, in words.
        scene: makes the scene.
        torque: torques [N m]: constant, or a function of the number of the control period, or of
            that and the simulation at its start (`feedback`).
        steps: number of control periods.
        period_ns: their length [ns].
        deviation: distance from the truth; None where a refusal is expected.
        bound: largest deviation that passes.
        refusal: name of the error that must end the run; empty where none may.
        stop_time: when the refusal must come [s]; None where that is not known.
        difficulty: why it is hard, in words.
        group: heading on the page.
        integrator: method.
        feedback: `torque` takes the simulation too.
        compiled_only: too long for plain Python; run by `report stability --long` alone.
        estimate: why the error estimate is held to WIDER_FACTOR; empty where FACTOR holds.

    """

    name: str
    expected: str
    scene: Callable[[], Scene]
    torque: Triple | Callable[..., Triple]
    steps: int
    period_ns: int
    deviation: Deviation | None = None
    bound: float = 0.0
    refusal: str = ""
    stop_time: Callable[[], float] | None = None
    difficulty: str = ""
    group: str = ""
    integrator: str = "auto"
    feedback: bool = False
    compiled_only: bool = False
    estimate: str = ""


@dataclass(frozen=True)
class CaseRun:
    """A simulation at its end, or the refusal and the simulation at its last state."""

    simulation: Simulation | None
    error: SstError | None


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
        loose_error, loose_estimate: true error and error estimate [rad] at the tolerance LOOSE;
            None where the error is not resolved.
        wall_s, compiled_s: time of the interpreted and of the compiled run, compilation included
            [s]; None where it was not run.
        same_bits: the compiled run ended in the same bits; None where only one was run.
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
    wall_s: float | None
    compiled_s: float | None
    same_bits: bool | None
    correct: bool

    @property
    def passed(self) -> bool:
        """The result is correct, and compiled and interpreted runs do not differ."""
        return self.correct and self.same_bits is not False


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
            for k in range(case.steps):
                torque = case.torque
                if callable(torque):
                    torque = torque(k, simulation) if case.feedback else torque(k)
                simulation.step(torque, case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, and with its compiled run."""
    jit = numba_version() is not None and (compiled or case.compiled_only)
    first, first_s = _timed(partial(run, case, compiled=case.compiled_only and jit))
    second, compiled_s = None, first_s if case.compiled_only else None
    if jit and not case.compiled_only and first.simulation is not None:
        second, compiled_s = _timed(partial(run, case, compiled=True))
    simulation, error = first.simulation, first.error
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
    loose_error = loose_estimate = None
    if simulation is not None:
        now, start = simulation.state, initial_state(simulation.scene, simulation.geometry)
        ends = (_stored(simulation, y) for y in ((*now.quaternion, *now.body_rate), start))
        energy = abs(simulation.energy_residual) / max(*map(abs, ends), 1e-300)
        closure, estimate = simulation.closure_residual, simulation.error_estimate
        if error is None and not case.compiled_only:
            loose_error, loose_estimate = estimate_check(case, simulation)
    if loose_error is not None and loose_estimate is not None:
        factor = WIDER_FACTOR if case.estimate else FACTOR
        if not loose_error / factor <= loose_estimate <= factor * loose_error:
            correct = False
            result += f"; the error estimate misses the true error by more than {factor:g} times"
    same_bits = None
    if second is not None and simulation is not None:
        same_bits = second.simulation is not None and (
            second.simulation.state == simulation.state and str(second.error) == str(error)
        )
        result += "" if same_bits else "; the compiled run differs"
    return CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, result, deviation,
        energy, closure, estimate, loose_error, loose_estimate,
        None if case.compiled_only else first_s, compiled_s, same_bits,
        correct,
    )  # fmt: skip


def estimate_check(case: Case, accurate: Simulation) -> tuple[float | None, float | None]:
    """Return true error and error estimate [rad] at the tolerance LOOSE; None if not resolved.

    Args:
        case: the case.
        accurate: its run at the default tolerance.

    """
    loose = run(case, tolerance=LOOSE).simulation
    if loose is None or loose.time_ns != accurate.time_ns:
        return None, None
    true = apart(loose, accurate)
    if true < max(ROUNDING, 100.0 * accurate.error_estimate):
        return None, None
    return true, loose.error_estimate


def _timed(call: Callable[[], CaseRun]) -> tuple[CaseRun, float]:
    began = time.perf_counter()
    done = call()
    return done, time.perf_counter() - began


def _stored(simulation: Simulation, y: Sequence[float]) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))
