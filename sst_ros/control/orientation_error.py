# SPDX-License-Identifier: Apache-2.0
"""Orientation errors, from quaternions (x, y, z, w) of length 1."""

from __future__ import annotations

import math

from sst_ros.control.reference import Quadruple, Triple
from sst_ros.control.star_motions import product


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
