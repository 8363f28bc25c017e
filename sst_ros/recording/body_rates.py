# SPDX-License-Identifier: Apache-2.0
"""The angular velocity of the star from the recorded rates of the joints."""

from __future__ import annotations

import numpy as np

from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry


def body_rates(
    geometry: Geometry, quaternion: Array, gamma_dot: Array, mu_dot: Array, beta_dot: Array
) -> Array:
    """Compute W in {E} [rad/s], shape (..., 3), from the rates of the joints [rad/s], (..., 3).

    It follows from each leg, W = w gamma_dot - r mu_dot - t beta_dot (Eq. 10), without a matrix
    that could be singular; the mean of the three is taken. Where the orientation is nan, it is.
    """
    known = np.isfinite(quaternion).all(axis=-1, keepdims=True)
    rotation = rotation_matrix(np.where(known, quaternion, (0.0, 0.0, 0.0, 1.0)))
    t, w = geometry.e, geometry.w @ rotation  # rows in {E}
    r = np.cross(t, w)
    r /= np.linalg.norm(r, axis=-1)[..., None]
    of_legs = w * gamma_dot[..., None] - r * mu_dot[..., None] - t * beta_dot[..., None]
    return np.asarray(np.where(known, of_legs.mean(axis=-2), np.nan))
