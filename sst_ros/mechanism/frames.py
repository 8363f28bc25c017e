# SPDX-License-Identifier: Apache-2.0
"""Vectors of three along the last axis; rotation matrices, quaternions (x, y, z, w), ZYZ angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.state import Array

_SMALL = 1000

_AHEAD, _BEHIND = np.array([1, 2, 0]), np.array([2, 0, 1])


def rotation_matrix(quaternion: ArrayLike) -> Array:
    """Rotation R of {E} in {B}, shape (..., 3, 3), of quaternions (x, y, z, w), (..., 4).

    Raises:
        ValueError: a quaternion is zero.

    """
    q = np.asarray(quaternion, dtype=float)
    length = np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    if np.any(length == 0.0):
        raise ValueError("a quaternion of length zero is no rotation")
    x, y, z, w = np.moveaxis(q / length, -1, 0)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        (xx - yy - zz + ww, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), -xx + yy - zz + ww, 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -xx - yy + zz + ww),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(rotation: ArrayLike) -> Array:
    """Quaternions (x, y, z, w) with w >= 0, shape (..., 4), of rotation matrices (..., 3, 3).

    The largest component comes from the diagonal (Markley, J. Guid. Control Dyn. 31 (2008)
    440-442). Where w is zero, the first other component that is not is positive.
    """
    m = np.asarray(rotation, dtype=float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    found = np.empty((*m.shape[:-2], 4, 4))  # four times a row's own component times all four
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[..., i, i] = 1.0 - trace + 2.0 * m[..., i, i]
        found[..., i, j] = m[..., j, i] + m[..., i, j]
        found[..., i, k] = m[..., k, i] + m[..., i, k]
        found[..., i, 3] = found[..., 3, i] = m[..., k, j] - m[..., j, k]
    found[..., 3, 3] = 1.0 + trace
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], trace], axis=-1)
    largest = np.argmax(diagonal, axis=-1)
    q = np.take_along_axis(found, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    signs = np.sign(np.roll(q, 1, axis=-1))  # w first
    first = np.argmax(signs != 0.0, axis=-1)
    sign = np.take_along_axis(signs, first[..., None], axis=-1)
    return np.asarray(np.where(sign < 0.0, -q, q))


def zyz_angles(rotation: ArrayLike) -> Array:
    """ZYZ angles [rad], (..., 3), of R = Rz(theta) Ry(phi) Rz(psi), (..., 3, 3), Eqs. 3, 6 to 8.

    theta and psi are in (-pi, pi], phi in [0, pi]. Where sin(phi) = 0 only theta + psi (phi = 0) or
    theta - psi (phi = pi) exists; there theta is 0 and psi carries it all.
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


def unwrap_zyz(angles: ArrayLike) -> Array:
    """ZYZ angles [rad] of a trajectory without jumps, shape (n, 3), as from `zyz_angles`.

    (theta, phi, psi) and (theta + pi, -phi, psi + pi) are the same rotation, so a motion straight
    through the pole is smooth in angles if phi may change its sign. Each sample takes that of the
    two forms, give or take full turns, that is nearest to the sample before; the first one off the
    pole is as given. At the pole itself (sin(phi) = 0, theta = 0) theta stays what it was and psi
    takes the rest, so theta + psi at phi = 0 and theta - psi at phi = pi are kept.
    """
    result = np.array(angles, dtype=float)
    off = np.flatnonzero(~np.isin(result[:, 1], (0.0, np.pi)))
    start = int(off[0]) if len(off) else 0
    for row in range(start + 1, len(result)):
        result[row] = _nearest(result[row - 1], result[row])
    for row in range(start - 1, -1, -1):
        result[row] = _nearest(result[row + 1], result[row])
    return result


def _nearest(to: Array, angles: Array) -> Array:
    """Form of the ZYZ angles, shape (3,), that is nearest to others."""
    theta, phi, psi = angles
    if phi in (0.0, np.pi):
        shift = to[0] - theta
        psi, theta = psi + (shift if phi else -shift), to[0]
        forms = np.array([[theta, phi, psi], [theta, -phi, psi]])
    else:
        forms = np.array([[theta, phi, psi], [theta + np.pi, -phi, psi + np.pi]])
    forms += 2.0 * np.pi * np.round((to - forms) / (2.0 * np.pi))
    return np.asarray(forms[np.argmin(np.abs(forms - to).sum(axis=1))])


def angle_between(first: ArrayLike, second: ArrayLike) -> Array:
    """Angle of the rotation between quaternions [rad], shape (...,); exact for tiny angles."""
    a, b = np.asarray(first), np.asarray(second)
    difference = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.asarray(4.0 * np.arcsin(np.minimum(difference / 2.0, 1.0)))


def cross(a: Array, b: Array) -> Array:
    """Vector product along the last axis; much faster than np.cross on small arrays."""
    if a.size < _SMALL:
        ahead = a.take(_AHEAD, -1) * b.take(_BEHIND, -1)
        return np.asarray(ahead - a.take(_BEHIND, -1) * b.take(_AHEAD, -1))
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0], out[..., 1], out[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return out


def dot(a: Array, b: Array) -> Array:
    """Scalar product along the last axis, of three; much faster than np.sum."""
    product = a * b
    return np.asarray(product[..., 0] + product[..., 1] + product[..., 2])


def columns(a: Array, b: Array, c: Array) -> Array:
    """Matrices (..., 3, 3) with the given columns."""
    out = np.empty((*a.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = a, b, c
    return out
