# SPDX-License-Identifier: Apache-2.0
"""What is stiff and extreme: what each case had to do, what it did, and what steps are stable.

Cases are those of `catalogue`, run by `Simulation` as for everybody. The largest stable step of a
method is found by bisection on one family, the scene `stiff` with other viscous coefficients.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sst_ros import scene as scenes
from sst_ros.errors import RunStopped
from sst_ros.integration.adaptive_stepper import AdaptiveStepper
from sst_ros.integration.compiled_method import CompiledMethod, Method
from sst_ros.integration.methods import METHODS
from sst_ros.progress import slices
from sst_ros.report import states
from sst_ros.report.states import Vector
from sst_ros.scene.loads import Friction, JointFriction
from sst_ros.scene.scene import Scene
from sst_ros.simulation import Simulation
from sst_ros.studies.extreme_cases import Case, cases, run
from sst_ros.studies.initial_value_problem import InitialValueProblem

VISCOSITIES = tuple(10.0**n for n in range(6))
"""Viscous coefficients of the stiff family [N m s/rad]."""

LONGEST_S = 1.0
"""Steps longer than this are not tried [s]."""

_SHORTEST_S, _STEPS, _RUNAWAY = 1e-9, 200, 10.0


@dataclass(frozen=True)
class Verdict:
    """What came of a case of the catalogue.

    Attributes:
        name: of the case.
        expected: what had to come out, in words.
        came: what came out, in words.
        deviation: distance from what was expected; None where a refusal was.
        bound: largest deviation that is right.
        energy: energy residual at the end, as a part of the energy; None where no run began.
        closure: largest abs(r_k . t_k) at the end; None where no run began.
        wall_s: how long it took [s].
        sound: it came out as it had to.

    """

    name: str
    expected: str
    came: str
    deviation: float | None
    bound: float
    energy: float | None
    closure: float | None
    wall_s: float
    sound: bool


@dataclass(frozen=True)
class Stable:
    """Largest stable step of a method [s]; LONGEST_S where none was too long.

    Attributes:
        method: its name.
        viscosity: viscous coefficient of the actuators [N m s/rad].
        decay: fastest decay at the start [1/s].
        step: the step [s].

    """

    method: str
    viscosity: float
    decay: float
    step: float


def viscous(stiff: Scene, coefficient: float) -> Scene:
    """Return the scene with another viscous coefficient of the actuators [N m s/rad]."""
    friction = JointFriction(gamma=Friction(viscous=coefficient))
    return dataclasses.replace(stiff, friction=friction)


def judge(case: Case) -> Verdict:
    """Run a case and compare with what had to come out."""
    began = time.perf_counter()
    outcome = run(case)
    deviation, came, sound = None, "", False
    simulation, error = outcome.simulation, outcome.error
    if error is not None:
        came = f"{type(error).__name__}: {str(error).splitlines()[0]}"
        sound = type(error).__name__ == case.refusal
        if sound and case.stop_time is not None and isinstance(error, RunStopped):
            right = case.stop_time()
            late = abs(error.time - right)
            came += f" ({late:.1e} s off)"
            sound = late <= 1e-6 * right + 1e-15
    elif simulation is not None:
        came = "finished"
        if case.deviation is not None:
            deviation = float(case.deviation(simulation))
            sound = deviation <= case.bound
    energy = closure = None
    if simulation is not None:
        now, begun = simulation.state, states.initial(simulation.scene)[:7]
        ends = (_stored(simulation, y) for y in ((*now.quaternion, *now.body_rate), begun))
        scale = max(*map(abs, ends), 1e-300)
        energy, closure = abs(simulation.energy_residual) / scale, simulation.closure_residual
    wall = time.perf_counter() - began
    return Verdict(case.name, case.expected, came, deviation, case.bound, energy, closure, wall,
                   sound)  # fmt: skip


def _stored(simulation: Simulation, y: Vector) -> float:
    """Kinetic and potential energy [J] of a quaternion and a body rate."""
    dynamics = simulation.dynamics
    rest = (0.0,) * (len(dynamics.state) - 7 + len(dynamics.drive))
    return float(sum(dynamics.energies(*y, *rest)[:2]))


def largest_step(problem: InitialValueProblem, method: Method) -> float:
    """Find by bisection the longest step [s] with which rates do not run away."""
    machine = CompiledMethod(problem.system, method, compiled=False)

    def stable(h: float) -> bool:
        try:
            with np.errstate(all="ignore"):
                y = machine.step_fixed(0.0, h, _STEPS, list(problem.start), problem.drive)
        except (ArithmeticError, ValueError):
            return False
        return all(map(math.isfinite, y)) and math.hypot(*y[4:7]) < _RUNAWAY

    return bisected(stable)


def bisected(stable: Callable[[float], bool]) -> float:
    """Return the largest h for which `stable` holds, to one per cent; nan where there is none."""
    if stable(LONGEST_S):
        return LONGEST_S
    low, high = math.log(_SHORTEST_S), math.log(LONGEST_S)
    if not stable(_SHORTEST_S):
        return math.nan
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(math.exp(middle)) else (low, middle)
    return math.exp(low)


def family(*, shown: bool = False) -> list[Stable]:
    """Find the largest stable step of every method at every viscosity."""
    stiff, found = scenes.load("stiff"), []
    for part in slices(len(VISCOSITIES), 1, "largest steps  ", shown):
        viscosity = VISCOSITIES[part.start]
        problem = InitialValueProblem(viscous(stiff, viscosity))
        stepper = AdaptiveStepper(problem.system, "dopri5", 1e-6, compiled=False)
        spectrum = stepper.spectrum(0.0, problem.start, problem.drive)
        decay = float(-spectrum.real.min())
        for method in METHODS.values():
            found.append(Stable(method.name, viscosity, decay, largest_step(problem, method)))
    return found


def verdicts(*, shown: bool = False) -> list[Verdict]:
    """Judge the whole catalogue."""
    every = list(cases())
    return [judge(every[part.start]) for part in slices(len(every), 1, "extreme cases  ", shown)]
