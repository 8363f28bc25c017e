# SPDX-License-Identifier: Apache-2.0
"""Which step suits a scene, from the spectrum of its linearised dynamics at the start."""

from __future__ import annotations

import math

import numpy as np

from sst_ros.control.torque_profiles import sine
from sst_ros.errors import SstError
from sst_ros.integration.adaptive_stepper import Walk
from sst_ros.integration.methods import DORMAND_PRINCE, RODAS4
from sst_ros.integration.ode import System
from sst_ros.scene.scene import Scene
from sst_ros.simulation import NANOSECONDS, Simulation

LONGEST_STEP = 1e-2
STABLE = 3.3
"""Dormand-Prince 5(4) is stable for h abs(lambda) up to about this on the negative real axis."""

ACCURATE = 0.3
"""h abs(lambda) at which its local error is far below 1e-6."""

PERIODS, PERIOD_NS = 20, 5_000_000
"""Over so many periods [ns] auto is watched."""


def advise(scene: Scene) -> str:
    """Say in a sentence which step and method to use, and why."""
    try:
        simulation = Simulation(scene)
    except SstError as error:
        return f"none, the scene cannot start: {error}"
    state, dynamics = simulation.state, simulation.dynamics
    lagged = (0.0,) * (len(dynamics.state) - 7)
    y = (*state.quaternion, *state.body_rate, *lagged)
    walk = Walk(System(dynamics), DORMAND_PRINCE.name, 1.0, compiled=False)
    eigenvalues = walk.spectrum(0.0, y, (0.0,) * len(dynamics.drive))
    fastest = float(np.abs(eigenvalues).max())
    if fastest == 0.0:
        return f"dopri5 with steps of {LONGEST_STEP:g} s; nothing moves fast at the start"
    limit = STABLE / fastest
    if _stiff(simulation, scene):
        return (
            f"auto, which changes to {RODAS4.name}: the scene is stiff; the fastest rate at the "
            f"start is {fastest:.3g} 1/s, and dopri5 would be unstable in steps above {limit:.2g} s"
        )
    step = _rounded(min(LONGEST_STEP, ACCURATE / fastest))
    return (
        f"dopri5 with steps of {step:g} s or less; the fastest rate at the start is "
        f"{fastest:.3g} 1/s, and steps above {limit:.2g} s would be unstable"
    )


def _stiff(simulation: Simulation, scene: Scene) -> bool:
    """Tell whether auto takes the method for stiff motions, over a short run."""
    profile = sine(scene.torque) if scene.torque else lambda _: (0.0, 0.0, 0.0)
    try:
        for period in range(PERIODS):
            simulation.step(profile(period * PERIOD_NS / NANOSECONDS), PERIOD_NS)
            if simulation.method == RODAS4.name:
                return True
    except SstError:
        pass  # the run is over before that
    return False


def _rounded(step: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step) + 1e-12)
    return power * max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= step * (1 + 1e-9))
