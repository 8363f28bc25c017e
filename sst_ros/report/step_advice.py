# SPDX-License-Identifier: Apache-2.0
"""Which method and step suit a scene, from the spectrum of its linearised dynamics at the start.

This is the advice of `scene show` and of the accuracy page, which measures its error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.initial_state import initial_state
from sst_ros.dynamics.traced_dynamics import ODE, Dynamics
from sst_ros.errors import SstError
from sst_ros.integration.methods import DORMAND_PRINCE, RODAS4
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS, WHOLE_MOTION_BUDGET, Simulation

LONGEST_STEP = 1e-2
"""Longest control period that is recommended [s]."""

STABLE = 3.3
"""Dormand-Prince 5(4) is stable for h abs(lambda) up to about this on the negative real axis."""

ACCURATE = 0.3
"""h abs(lambda) at which its local error is far below 1e-6."""

TOLERANCE = 1e-10
"""Local tolerance that goes with the advice; `Simulation` divides the period where it must."""

PERIODS, PERIOD_NS = 20, 5_000_000
"""Number and length [ns] of the control periods over which `auto` is run to see what it chooses."""


@dataclass(frozen=True)
class StepAdvice:
    """A recommendation.

    Attributes:
        text: one sentence.
        method: name of the method.
        step: longest control period [s]; None where the scene cannot start.
        stiff: `auto` changes to the implicit method.
        tolerance: local tolerance.

    """

    text: str
    method: str = "auto"
    step: float | None = None
    stiff: bool = False
    tolerance: float = TOLERANCE


def step_advice(scene: Scene) -> StepAdvice:
    """Recommend a method and a step for a scene."""
    try:
        simulation = Simulation(scene, step_budget=WHOLE_MOTION_BUDGET)
    except SstError as error:
        return StepAdvice(f"none, the scene cannot start: {error}")
    fastest = float(np.abs(eigenvalues(scene)).max())
    name = DORMAND_PRINCE.name
    if fastest == 0.0:
        text = f"{name} with steps of {LONGEST_STEP:g} s; nothing moves fast at the start"
        return StepAdvice(text, name, LONGEST_STEP)
    limit, rate = STABLE / fastest, f"the fastest rate at the start is {fastest:.3g} 1/s"
    if _stiff(simulation, scene):
        text = (
            f"auto, which changes to {RODAS4.name}: the scene is stiff; {rate}, and {name} would "
            f"be unstable in steps above {limit:.2g} s"
        )
        return StepAdvice(text, "auto", LONGEST_STEP, stiff=True)
    step = _rounded(min(LONGEST_STEP, ACCURATE / fastest))
    text = (
        f"{name} with steps of {step:g} s or less; {rate}, and steps above {limit:.2g} s would be "
        "unstable"
    )
    return StepAdvice(text, name, step)


def eigenvalues(scene: Scene) -> NDArray[np.complex128]:
    """Eigenvalues of the linearised dynamics at the start [1/s]."""
    dynamics = Dynamics.of(scene)
    start = initial_state(scene, Geometry.of(scene))
    lagged = (0.0,) * (len(dynamics.state) - 7)
    drive = (0.0,) * len(dynamics.drive)
    return np.asarray(ODE(dynamics).eigenvalues(0.0, (*start, *lagged), drive), dtype=complex)


def _stiff(simulation: Simulation, scene: Scene) -> bool:
    """Return whether `auto` changes to the implicit method in a short run."""
    profile = scene.torque.at if scene.torque else lambda _: (0.0, 0.0, 0.0)
    try:
        for period in range(PERIODS):
            simulation.step(profile(period * PERIOD_NS / NANOSECONDS), PERIOD_NS)
            if simulation.method == RODAS4.name:
                return True
    except SstError:
        pass  # the run ends before that
    return False


def _rounded(step: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step) + 1e-12)
    return power * max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= step * (1 + 1e-9))
