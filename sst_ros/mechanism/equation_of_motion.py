# SPDX-License-Identifier: Apache-2.0
"""M gamma_ddot + h = tau + J^T n_ext, and what it is worth: energy, momentum, power.

The paper writes T1 gamma_ddot + T2 + tau = 0 (Eq. 90); M = -T1 is symmetric and positive definite
and h = -T2 at n_ext = 0 holds the velocity products. All inertia tensors may be full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.geometry import Array, frozen
from sst_ros.mechanism.virtual_work import Mechanism, Posture


@dataclass(frozen=True)
class EquationOfMotion:
    """EquationOfMotion at one posture and rate. Arrays are read-only.

    Attributes:
        m: mass matrix M = -T1 [kg m^2], shape (3, 3).
        h: velocity products [N m], shape (3,).
        j: J, omega = J gamma_dot, shape (3, 3).
        gamma_dot: actuator rates [rad/s], shape (3,).

    """

    m: Array
    h: Array
    j: Array
    gamma_dot: Array

    @classmethod
    def of(cls, mechanism: Mechanism, at: Posture, gamma_dot: ArrayLike) -> EquationOfMotion:
        """Evaluate Eqs. 63 to 92 once."""
        rate = np.array(gamma_dot, dtype=float)
        t1, t2 = virtual_work.equation_of_motion(mechanism, at, rate)
        # Rounding leaves T1 symmetric to 1e-16 only; M is symmetric.
        return cls(*frozen(-0.5 * (t1 + t1.T), -t2, at.j.copy(), rate))

    @property
    def momentum(self) -> Array:
        """Generalized momentum M gamma_dot [N m s], shape (3,)."""
        return np.asarray(self.m @ self.gamma_dot)

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy of the seven links [J]."""
        return 0.5 * float(self.gamma_dot @ self.m @ self.gamma_dot)

    def power(self, torque: ArrayLike, moment: ArrayLike = (0.0, 0.0, 0.0)) -> float:
        """Power of actuator torques and of n_ext on the star in {B} [W]: d/dt kinetic_energy."""
        return float(self.gamma_dot @ self._driving(torque, moment))

    def acceleration(self, torque: ArrayLike, moment: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Direct dynamics: gamma_ddot [rad/s^2], shape (3,), of torques and n_ext [N m]."""
        return np.asarray(np.linalg.solve(self.m, self._driving(torque, moment) - self.h))

    def torque(self, gamma_ddot: ArrayLike, moment: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Inverse dynamics: actuator torques [N m], shape (3,), that give gamma_ddot [rad/s^2]."""
        acceleration = np.asarray(gamma_ddot, dtype=float)
        return np.asarray(self.m @ acceleration + self.h - self._driving((0.0, 0.0, 0.0), moment))

    def _driving(self, torque: ArrayLike, moment: ArrayLike) -> Array:
        applied = np.asarray(torque, dtype=float)
        return np.asarray(applied + self.j.T @ np.asarray(moment, dtype=float))
