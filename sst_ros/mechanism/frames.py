# SPDX-License-Identifier: Apache-2.0
"""Orientation of the star: rotation matrices, quaternions (x, y, z, w), ZYZ angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sst_ros.mechanism.geometry import Array


def rotation_matrix(quaternion: ArrayLike) -> Array:
    """Rotation R of {E} in {B}, shape (..., 3, 3), of quaternions (x, y, z, w), (..., 4)."""
    return np.asarray(Rotation.from_quat(np.asarray(quaternion)).as_matrix())


def quaternion_of(rotation: ArrayLike) -> Array:
    """Quaternions (x, y, z, w) with w >= 0, shape (..., 4), of rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(np.asarray(rotation)).as_quat(canonical=True))


def zyz_angles(rotation: ArrayLike) -> Array:
    """ZYZ angles (theta, phi, psi) of R = Rz(theta) Ry(phi) Rz(psi), Eqs. 3 and 6 to 8.

    Args:
        rotation: R, shape (..., 3, 3).

    Returns:
        Angles [rad], shape (..., 3): theta, psi in (-pi, pi], phi in [0, pi]. Where sin(phi) = 0
        only theta + psi (phi = 0) or theta - psi (phi = pi) exists; there theta is 0 and psi
        carries it all.

    """
    r = np.asarray(rotation, dtype=float)
    sine = np.hypot(r[..., 0, 2], r[..., 1, 2])
    pole = sine == 0.0
    theta = np.where(pole, 0.0, np.arctan2(r[..., 1, 2], r[..., 0, 2]))
    psi = np.where(
        pole,
        np.arctan2(r[..., 1, 0], r[..., 1, 1]),
        np.arctan2(r[..., 2, 1], -r[..., 2, 0]),
    )
    return np.stack([theta, np.arctan2(sine, r[..., 2, 2]), psi], axis=-1)


def angle_between(first: ArrayLike, second: ArrayLike) -> Array:
    """Angle of the rotation between quaternions [rad], shape (...,); exact for tiny angles."""
    a, b = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    difference = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(difference / 2.0, 1.0)))
