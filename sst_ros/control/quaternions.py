# SPDX-License-Identifier: Apache-2.0
"""Quaternions (x, y, z, w) of rotations."""

from __future__ import annotations

import math

from sst_ros.control.reference import Quadruple, Triple


def product(a: Quadruple, b: Quadruple) -> Quadruple:
    """Product of quaternions (x, y, z, w): first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by + ay * bw + az * bx - ax * bz,
        aw * bz + az * bw + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def about_z(angle: float) -> Quadruple:
    """Quaternion of a turn about z."""
    return (0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle))


def unit(q: Quadruple) -> Quadruple:
    """Quaternion of length 1."""
    length = math.hypot(*q)
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)


def between(first: Quadruple, second: Quadruple) -> Quadruple:
    """Quaternion of R1^T R2: the second orientation relative to the first."""
    x, y, z, w = first
    return product((-x, -y, -z, w), second)


def rotation_vector(quaternion: Quadruple) -> Triple:
    """Axis times angle, 0 to pi [rad], of a rotation; exact for tiny angles."""
    sign = math.copysign(1.0, quaternion[3])
    x, y, z, w = (sign * part for part in quaternion)
    sine = math.hypot(x, y, z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
    return factor * x, factor * y, factor * z
