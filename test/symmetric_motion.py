# SPDX-License-Identifier: Apache-2.0
"""The symmetric motion of the isotropic manipulator: one degree of freedom, as in
Example 1.

Where the base triangle has right angles, the arcs are 120 degrees apart, all legs are
alike and all torques are equal, all gamma_k stay equal and E stays at the centre. The
angle of the star about s obeys tan psi = sqrt(3) tan x with x = gamma_k - pi/4, and
Lagrange's equation of x is

    M1(x) x_ddot + M1'(x) x_dot^2 / 2 = tau(t),
    M1(x) = I_zz / d^2 + Ia_zz + Ip_yy + 2 Ip_xx cos^2 x / d^2,  d = 2 - cos 2x,

with the star's inertia I in {E}, those of the links Ia in {1k} and Ip in {2k}.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import newton

from sst_ros.mechanism.virtual_work import Mechanism
from sst_ros.scene.scene import Scene

HOME = math.pi / 4
"""gamma_k [rad] at x = 0: every carriage is in the middle of its side."""


def inertia(scene: Scene, x: Any) -> Any:
    """M1(x) [kg m^2], twice the kinetic energy of a leg's share over x_dot^2."""
    star, link = scene.star.inertia, scene.intermediate_links[0].tensor
    d, c = 2.0 - np.cos(2.0 * x), np.cos(x)
    axial = Mechanism.of(scene).actuated[0][2][2] + link[1][1]
    return star.zz / d**2 + axial + 2.0 * link[0][0] * c**2 / d**2


def inertia_slope(scene: Scene, x: float) -> float:
    """M1'(x) [kg m^2/rad], to rounding: a step into the complex plane subtracts
    nothing.
    """
    return float(inertia(scene, x + 1e-100j).imag / 1e-100)


def drift_free_rate(scene: Scene) -> float:
    """Find the initial rate [rad/s] at gamma_k = pi/4 with which gamma returns after
    one period.

    The paper's rate for Example 1 is lost; this is the one that makes its motion
    periodic, whatever the inertias are. The scene is symmetric, with the same sine
    torque at all legs.
    """
    torque = scene.torque
    amplitude, frequency, phase = (
        torque.amplitude[0],
        torque.frequency[0],
        torque.phase[0],
    )
    period = 2.0 * math.pi / frequency

    def rates(t: float, y: tuple[float, float]) -> tuple[float, float]:
        torque = amplitude * math.sin(frequency * t + phase)
        push = torque - 0.5 * inertia_slope(scene, y[0]) * y[1] ** 2
        return y[1], push / inertia(scene, y[0])

    def drift(rate: float) -> float:
        # SciPy's tightest; the steps are shorter than it asks for, so that only
        # rounding is left.
        run = solve_ivp(
            rates,
            (0.0, period),
            (0.0, rate),
            "DOP853",
            rtol=1e-13,
            atol=1e-15,
            max_step=period / 300,
        )
        return float(run.y[0, -1])

    # For a constant inertia the rate is -amplitude cos(phase) / (frequency M1).
    near = -amplitude * math.cos(phase) / (frequency * inertia(scene, 0.0))
    # the secant's last step
    return float(newton(drift, near, x1=0.9 * near, tol=1e-13))
