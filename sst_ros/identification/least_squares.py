# SPDX-License-Identifier: Apache-2.0
"""Weighted linear least squares: estimates, their covariance, the condition of the problem.

The variance of the noise differs between actuators; it is estimated from the residuals of an
unweighted fit, by which the equations are then divided (Gautier 1997; Swevers, Verdonck and
De Schutter, IEEE Control Systems 27 (2007) no. 5, 58-71).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from sst_ros.mechanism.geometry import Array

EXACT = 1e-12
"""Noise over RMS torque that is assumed at least: data of a simulation have no other."""


@dataclass(frozen=True)
class LinearFit:
    """Estimates of b numbers.

    Attributes:
        estimate: shape (b,).
        covariance: shape (b, b).
        root: R of the weighted regressor, R^T R = covariance^-1, shape (b, b).
        noise: standard deviation of the residuals of each actuator [N m], shape (3,).
        residual: measured less predicted torques [N m], shape (m, 3).
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
        first, _, _ = _solved(columns, torque, np.ones(3))
        weights = _noise(torque - columns @ first, len(first), floor)
        second, _, _ = _solved(columns, torque, weights)
        noise = _noise(torque - columns @ second, len(second), floor)
    estimate, root, condition = _solved(columns, torque, noise)
    inverse = solve_triangular(root, np.eye(len(root)))
    residual = torque - columns @ estimate
    return LinearFit(estimate, inverse @ inverse.T, root, noise, residual, condition)


def _noise(residual: Array, unknowns: int, floor: float) -> Array:
    """Return the standard deviation of each actuator; the unknowns are shared out between them."""
    free = max(len(residual) - unknowns / 3.0, 1.0)
    return np.asarray(np.maximum(np.sqrt(np.sum(residual**2, axis=0) / free), floor))


def _solved(columns: Array, torque: Array, noise: Array) -> tuple[Array, Array, float]:
    """Estimate, R of the weighted regressor, and its condition with columns of length one."""
    matrix = (columns / noise[:, None]).reshape(-1, columns.shape[-1])
    right = (torque / noise).ravel()
    lengths = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / lengths)
    estimate = solve_triangular(r, q.T @ right)
    # One step of refinement: noise-free data are fitted to rounding.
    estimate = estimate + solve_triangular(r, q.T @ (right - matrix / lengths @ estimate))
    return estimate / lengths, r * lengths, float(np.linalg.cond(r))
