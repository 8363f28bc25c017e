# SPDX-License-Identifier: Apache-2.0
"""A stiff or extreme case: what is run, and the truth; its run by `Simulation` or the run loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sst_ros.errors import SstError
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import WHOLE_MOTION_BUDGET, Simulation
from studies.extreme_scenes import Triple
from studies.loop_runs import run_in_loop

Deviation = Callable[[Simulation], float]

LOOSE = 1e-6
"""Tolerance of the run whose error estimate is checked."""


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
        compiled_only: too long for plain Python; run by `studies.extreme --long` alone.
        loose: tolerance at which the error estimate is checked; None where it cannot be.
        estimate: why `loose` is not LOOSE; empty where it is.

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
    loose: float | None = LOOSE
    estimate: str = ""

    def torque_at(self, simulation: Simulation) -> Triple:
        """Return the torques of the control period that begins now [N m]."""
        if not callable(self.torque):
            return self.torque
        k = simulation.time_ns // self.period_ns
        return self.torque(k, simulation) if self.feedback else self.torque(k)


@dataclass(frozen=True)
class CaseRun:
    """A simulation at its end, or the refusal and the simulation at its last state."""

    simulation: Simulation | None
    error: SstError | None


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
    """Run a case through the run loop of the node, interpreted."""

    def build(scene: Scene) -> Simulation:
        return Simulation(scene, case.integrator, step_budget=WHOLE_MOTION_BUDGET)

    loop, _ = run_in_loop(case.scene(), build, case.torque_at, case.period_ns, case.steps)
    return CaseRun(loop.simulation, SstError(loop.fault) if loop.fault else None)
