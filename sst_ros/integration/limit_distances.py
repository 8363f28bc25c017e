# SPDX-License-Identifier: Apache-2.0
"""Distances from the limits of a scene, traced: event functions without an inverse tangent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sst_ros.dynamics.kernel import Leg, Model, leg_motion
from sst_ros.dynamics.limits import Limit
from sst_ros.dynamics.loads import LegMotion
from sst_ros.mechanism.generic_math import Scalar, dot, rotation_rows


def limit_distances(
    limits: Sequence[Limit],
    ends: Sequence[tuple[Scalar, Scalar]],
    model: Model,
    state: Sequence[Any],
) -> tuple[Scalar, ...]:
    """Return a number for each limit, positive inside, for angles less than pi away from it.

    Args:
        limits: which joints, and on which side.
        ends: cosine and sine of the end of each.
        model: constants.
        state: quaternion and body rate.

    """
    x, y, z, w, *rate = state
    rows = rotation_rows((x, y, z, w))
    legs = [leg_motion(leg, rows, (rate[0], rate[1], rate[2])) for leg in model.legs]
    return tuple(
        _distance(limit, *end, legs[limit.leg], model.legs[limit.leg])
        for limit, end in zip(limits, ends, strict=True)
    )


def _distance(limit: Limit, cosine: Scalar, sine: Scalar, at: LegMotion, leg: Leg) -> Scalar:
    """sin(sign * (angle - end)) times something positive."""
    if limit.joint < 3:
        along, across = dot(at.outward, leg.v), dot(at.outward, leg.across)
    elif limit.joint < 6:
        return at.u - sine * sine
    else:
        along, across = at.p[2], at.p[0] * leg.e1 - at.p[1] * leg.e0
    return limit.sign * (across * cosine - along * sine)
