# SPDX-License-Identifier: Apache-2.0
"""The companion of a run: steps of twice the length, from whose distance the error is told.

Its distance from the run is 2^order - 1 times the error of the run as steps go to zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sst_ros.dynamics.limits import Limit

_ROUNDING = 64 * 2.220446049250313e-16
_AT_REST = 1e-7

Vector = Sequence[float]


def errors(y: Vector, z: Vector, order: int, legs: int) -> tuple[float, float]:
    """Estimated global errors of orientation [rad] and body rate [rad/s] after `legs` steps.

    Twice what the distance says as steps go to zero: at loose tolerances the terms of the next
    orders hide a part of it.
    """
    ahead = math.dist(y[:4], z[:4]), math.dist(y[:4], [-x for x in z[:4]])
    apart = (2.0 * min(ahead), math.dist(y[4:7], z[4:7]))
    rounding = _ROUNDING * math.sqrt(legs + 1.0)
    share = 2.0 / (2.0**order - 1.0)
    scale = (1.0, max(1.0, math.hypot(*y[4:7])))
    first, second = (
        max(d * share, min(d, rounding * s)) for d, s in zip(apart, scale, strict=True)
    )
    return first, second


def rescaled(y: Vector, z: Vector, order: int, new: int) -> list[float]:
    """Move the companion so that under a method of order `new` it stands for the same error."""
    if order == new:
        return z if isinstance(z, list) else list(z)
    grow = (2.0**new - 1.0) / (2.0**order - 1.0)
    return [a + grow * (b - a) for a, b in zip(y, z, strict=True)]


def time_to(limit: Limit, joints: Vector) -> float:
    """Time until a companion meets a limit [s], in first order; zero where that says nothing."""
    margin, slope = limit.margin(joints), limit.slope(joints)
    return -margin / slope if abs(margin) < 1e-2 and abs(slope) > _AT_REST else 0.0


def moved(y: Vector, slope: Vector, time: float) -> list[float]:
    """Go on along a straight line."""
    return [a + time * b for a, b in zip(y, slope, strict=True)]
