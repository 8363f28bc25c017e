# SPDX-License-Identifier: Apache-2.0
"""Fourier series that begin and end at rest.

gamma_k(t) = c_k + sum over n of a_nk sin(n w t) + b_nk cos(n w t), w = 2 pi / duration (Swevers,
Ganseman, Tukel, De Schutter and Van Brussel, IEEE Trans. Robotics Autom. 13 (1997) 730-740). The
coefficients are taken from the subspace in which the motion begins and ends at rest: gamma = c,
gamma_dot = gamma_ddot = 0.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from sst_ros.mechanism.geometry import Array

POINTS = 12
"""Samples, and points of the scene, in a period of the highest harmonic."""


class FourierSeries:
    """Angles of three actuators as functions of free numbers.

    Args:
        duration: of the motion [s].
        harmonics: of the series.
        centre: angles at both ends [rad], shape (3,).

    Attributes:
        size: number of the free numbers.
        times: samples [s], POINTS in a period of the highest harmonic, shape (n,).

    """

    def __init__(self, duration: float, harmonics: int, centre: Array) -> None:
        self.duration, self.centre = duration, centre
        n = np.arange(1, harmonics + 1)
        self._frequency = 2.0 * np.pi * n / duration
        rest = np.zeros((3, 2 * harmonics))  # gamma, gamma_dot, gamma_ddot at the beginning
        rest[0, harmonics:], rest[1, :harmonics], rest[2, harmonics:] = 1.0, n, n * n
        self._basis = null_space(rest)
        self.size = 3 * self._basis.shape[1]
        count = POINTS * harmonics
        self.times = np.arange(1, count + 1) * duration / count

    def at(self, free: Array, t: Array) -> tuple[Array, Array, Array]:
        """Angles [rad] and two derivatives at the times t [s], each shape (len(t), 3)."""
        sine, cosine = np.split(self._basis @ free.reshape(-1, 3), 2)
        w = self._frequency
        s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
        return (
            self.centre + s @ sine + c @ cosine,
            (c * w) @ sine - (s * w) @ cosine,
            -(s * w * w) @ sine - (c * w * w) @ cosine,
        )
