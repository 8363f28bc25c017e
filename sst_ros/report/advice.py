# SPDX-License-Identifier: Apache-2.0
"""Which step suits a scene, from the spectrum of its linearised dynamics at the start."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import SstError
from sst_ros.mechanism.compiled import Dynamics
from sst_ros.scene import Scene
from sst_ros.simulation import Simulation

LONGEST_STEP = 1e-2
STABLE = 3.3
"""Dormand-Prince 5(4) is stable for h abs(lambda) up to about this on the negative real axis."""

ACCURATE = 0.3
"""h abs(lambda) at which its local error is far below 1e-6."""


def spectrum(
    dynamics: Dynamics, y: tuple[float, ...], drive: tuple[float, ...]
) -> NDArray[np.complex128]:
    """Eigenvalues of d(dy/dt)/dy [1/s], one for each number of the state."""
    size = len(y)
    flat = dynamics.linearised(*y, *drive)[size:]
    return np.asarray(np.linalg.eigvals(np.array(flat).reshape(size, size).T))


def advise(scene: Scene) -> str:
    """Say in a sentence which step and method to use, and why."""
    try:
        simulation = Simulation(scene)
    except SstError as error:
        return f"none, the scene cannot start: {error}"
    state, dynamics = simulation.state, simulation.dynamics
    lagged = (0.0,) * (len(dynamics.state) - 7)
    y = (*state.quaternion, *state.body_rate, *lagged)
    fastest = float(np.abs(spectrum(dynamics, y, (0.0,) * len(dynamics.drive))).max())
    if fastest == 0.0:
        return f"dopri5 with steps of {LONGEST_STEP:g} s; nothing moves fast at the start"
    step = _rounded(min(LONGEST_STEP, ACCURATE / fastest))
    limit = STABLE / fastest
    return (
        f"dopri5 with steps of {step:g} s or less; the fastest rate at the start is "
        f"{fastest:.3g} 1/s, and steps above {limit:.2g} s would be unstable"
    )


def _rounded(step: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(step) + 1e-12)
    return power * max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= step * (1 + 1e-9))
