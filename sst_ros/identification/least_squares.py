# SPDX-License-Identifier: Apache-2.0
"""Weighted linear least squares: estimates, their covariance, the condition of the problem.

The variance of the noise differs between actuators; it is estimated from the residuals of an
unweighted fit, over the equations of the actuator less the unknowns that they determine (their
leverage), and the equations are then divided by it (Gautier 1997; Swevers, Verdonck and
De Schutter, IEEE Control Systems 27 (2007) no. 5, 58-71).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sst_ros.mechanism.geometry import Array

EXACT = 1e-12
"""Noise over RMS torque that is assumed at least: data of a simulation have no other."""


_WEIGHTINGS = 2


@dataclass(frozen=True)
class LinearFit:
    """Estimates of b numbers.

    Attributes:
        estimate: shape (b,).
        covariance: shape (b, b).
        root: R of the weighted regressor, R^T R = covariance^-1, shape (b, b).
        noise: standard deviation of the residuals of each actuator [N m], shape (3,).
        residual: measured less predicted torques [N m] of the m equations, shape (m, 3).
        condition: of the weighted regressor with columns of length one.

    """

    estimate: Array
    covariance: Array
    root: Array
    noise: Array
    residual: Array
    condition: float

    @property
    def deviation(self) -> Array:
        """Standard deviations, shape (b,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def weighted_fit(columns: Array, torque: Array, noise: Array | None = None) -> LinearFit:
    """Fit torque = columns estimate.

    Args:
        columns: regressor of independent columns, shape (m, 3, b).
        torque: measured less known torques [N m], shape (m, 3).
        noise: standard deviations of the torques [N m], shape (3,); by default estimated.

    """
    floor = EXACT * float(np.sqrt(np.mean(torque**2))) + 1e-300
    if noise is None:
        noise = np.ones(3)
        for _ in range(_WEIGHTINGS):
            estimate, _, leverage = _solved(columns, torque, noise)
            free = np.maximum(len(torque) - leverage, 1.0)
            squares = np.sum((torque - columns @ estimate) ** 2, axis=0)
            noise = np.maximum(np.sqrt(squares / free), floor)
    estimate, root, _ = _solved(columns, torque, noise)
    condition = float(np.linalg.cond(root / np.linalg.norm(root, axis=0)))
    inverse = solve_triangular(root, np.eye(len(root)))
    residual = torque - columns @ estimate
    return LinearFit(estimate, inverse @ inverse.T, root, noise, residual, condition)


def _solved(columns: Array, torque: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Estimate, R of the weighted regressor, and the unknowns that each actuator determines."""
    matrix = (columns / noise[:, None]).reshape(-1, columns.shape[-1])
    right = (torque / noise).ravel()
    lengths = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / lengths)
    estimate = solve_triangular(r, q.T @ right)
    # One step of refinement: noise-free data are fitted to rounding.
    estimate = estimate + solve_triangular(r, q.T @ (right - matrix / lengths @ estimate))
    leverage = np.sum((q**2).reshape(-1, 3, len(r)), axis=(0, 2))
    return estimate / lengths, r * lengths, leverage
