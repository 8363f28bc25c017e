# SPDX-License-Identifier: Apache-2.0
"""A stiff or extreme case: what is run, the truth, and how its result is evaluated."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import RunStopped, SstError
from sst_ros.integration.codegen import numba_version
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation

Triple = tuple[float, float, float]
Deviation = Callable[[Simulation], float]


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: short name.
        expected: the truth and its reason, in words.
        scene: makes the scene.
        torque: torques [N m], constant or by the number of the control period.
        steps: number of control periods.
        period_ns: their length [ns].
        deviation: distance from the truth; None where a refusal is expected.
        bound: largest deviation that passes.
        refusal: name of the error that must end the run; empty where none may.
        stop_time: when the refusal must come [s]; None where that is not known.
        difficulty: why it is hard, in words.
        group: heading on the page.

    """

    name: str
    expected: str
    scene: Callable[[], Scene]
    torque: Triple | Callable[[int], Triple]
    steps: int
    period_ns: int
    deviation: Deviation | None = None
    bound: float = 0.0
    refusal: str = ""
    stop_time: Callable[[], float] | None = None
    difficulty: str = ""
    group: str = ""


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
        wall_s: time of the interpreted run [s].
        same_bits: the compiled run ended in the same bits; None where it was not run.
        correct: the result is the truth.

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
    wall_s: float
    same_bits: bool | None
    correct: bool

    @property
    def passed(self) -> bool:
        """The result is correct, and compiled and interpreted runs do not differ."""
        return self.correct and self.same_bits is not False


def run(case: Case, *, compiled: bool = False) -> CaseRun:
    """Run a case; refusals are results."""
    simulation = None
    try:
        simulation = Simulation(case.scene(), compiled=compiled, step_budget=WHOLE_MOTION_BUDGET)
        for k in range(case.steps):
            torque = case.torque(k) if callable(case.torque) else case.torque
            simulation.step(torque, case.period_ns)
    except SstError as error:
        return CaseRun(simulation, error)
    return CaseRun(simulation, None)


def evaluate_case(case: Case, *, compiled: bool = True) -> CaseResult:
    """Run a case, compare it with the truth, and with its compiled run."""
    began = time.perf_counter()
    done = run(case)
    wall = time.perf_counter() - began
    simulation, error = done.simulation, done.error
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
    same_bits = None
    if compiled and simulation is not None and numba_version() is not None:
        again = run(case, compiled=True)
        same_bits = again.simulation is not None and (
            again.simulation.state == simulation.state and str(again.error) == str(error)
        )
        result += "" if same_bits else "; the compiled run differs"
    return CaseResult(
        case.name, case.group, case.difficulty, case.expected, case.bound, result, deviation,
        energy, closure, estimate, wall, same_bits, correct,
    )  # fmt: skip


def _stored(simulation: Simulation, y: Sequence[float]) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))
