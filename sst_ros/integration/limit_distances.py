# SPDX-License-Identifier: Apache-2.0
"""Distances from the limits of a scene, traced: event functions without an inverse tangent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sst_ros.dynamics.kernel import Leg, Model, leg_motion
from sst_ros.dynamics.limits import Limit
from sst_ros.dynamics.model import LegMotion
from sst_ros.mechanism.generic_math import Scalar, dot, rotation_rows


def limit_distances(
    limits: Sequence[Limit],
    ends: Sequence[tuple[Scalar, Scalar]],
    model: Model,
    state: Sequence[Any],
) -> tuple[Scalar, ...]:
    """Return a number for each limit, positive inside, then the rate of each.

    They hold for angles less than pi away from the limit.

    Args:
        limits: which joints, and on which side.
        ends: cosine and sine of the end of each.
        model: constants.
        state: quaternion and body rate.

    """
    x, y, z, w, *rate = state
    rows = rotation_rows((x, y, z, w))
    legs = [leg_motion(leg, rows, (rate[0], rate[1], rate[2])) for leg in model.legs]
    pairs = [
        _distance(limit, *end, legs[limit.leg], model.legs[limit.leg])
        for limit, end in zip(limits, ends, strict=True)
    ]
    return tuple(pair[0] for pair in pairs) + tuple(pair[1] for pair in pairs)


def _distance(
    limit: Limit, cosine: Scalar, sine: Scalar, at: LegMotion, leg: Leg
) -> tuple[Scalar, Scalar]:
    """sqrt(u) sin(sign * (angle - end)) and its rate; of mu sin(mu)^2 - sin(end)^2."""
    if limit.joint < 3:
        along, across, rate = dot(at.outward, leg.v), dot(at.outward, leg.across), at.gamma_dot
    elif limit.joint < 6:
        return at.u - sine * sine, -2.0 * at.a * at.a_dot
    else:
        along, across, rate = at.p[2], at.p[0] * leg.e1 - at.p[1] * leg.e0, at.beta_dot
    distance = limit.sign * (across * cosine - along * sine)
    turning = limit.sign * (along * cosine + across * sine) * rate
    return distance, turning - distance * at.a * at.a_dot / at.u
