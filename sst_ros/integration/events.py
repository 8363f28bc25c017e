# SPDX-License-Identifier: Apache-2.0
"""Events inside a step: when a joint reaches a limit, or meets or leaves an elastic stop.

The force of an elastic stop has a kink where contact begins and ends, so steps end there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from sst_ros.dynamics.model import CONTACT_BAND, Limit

Signal = Callable[[float], float]

TIME_TOLERANCE = 1e-15
"""Accuracy of a located time [s], above the rounding of the time itself."""

GRAZING = 1e-12
"""A distance below this [rad] counts as zero: closure and rounding reach 1e-15."""


def may_occur(event: Limit, begin: Sequence[float], end: Sequence[float]) -> bool:
    """Test cheaply whether an event may lie in a step, given the joints at both ends.

    A limit counts where the step starts on it; a contact that the step starts on does not.
    """
    before = event.distance(begin)
    if event.error is not None:
        if before <= 0.0:
            return True
    elif before <= GRAZING and not (before > -CONTACT_BAND and event.slope(begin) > 0.0):
        return False
    return event.distance(end) < 0.0 or event.slope(begin) < 0.0 < event.slope(end)


def just_beyond(event: Limit, x: float, joints: Sequence[float], h: float) -> float:
    """Time just after an event at x, where the Jacobian is that of the side beyond the kink."""
    return min(x + min(1e-14 / max(abs(event.slope(joints)), 1e-200), 1e-3 * h), h)


def first_crossing(distance: Signal, slope: Signal, h: float) -> float | None:
    """Time x in [0, h] at which `distance` becomes negative, or None.

    Both signals are smooth functions of the time since the step began and `slope` is the rate of
    `distance`. A dip below zero and back inside the step is found where the slope changes sign
    once. A distance that starts at zero counts if it shrinks, and not if it grows.
    """
    begin, end = 0.0, h
    rising, falling = slope(0.0) > 0.0, slope(h) < 0.0
    if distance(0.0) <= GRAZING:
        if not rising:
            leaves = slope(0.0) < 0.0 or distance(h) < -GRAZING  # from rest, the latter
            return 0.0 if distance(0.0) < -GRAZING or leaves else None
        if distance(h) >= 0.0 or (distance(h) >= -GRAZING and not falling):
            return None
        # It grew first: the crossing lies behind the maximum.
        begin = _root(slope, 0.0, h) if falling else 0.0
    elif distance(h) >= 0.0:
        if rising or falling:
            return None
        end = _root(slope, 0.0, h)
        if distance(end) >= 0.0:
            return None
    return _root(distance, begin, end)


def first_event(
    limits: Iterable[Limit], joints: Callable[[float], Sequence[float]], h: float
) -> tuple[float, Limit] | None:
    """Return time in [0, h] and limit of the first event; `joints` are those at a time."""
    found = []
    for limit in limits:
        x = first_crossing(
            lambda x, at=limit: at.distance(joints(x)),  # type: ignore[misc]
            lambda x, at=limit: at.slope(joints(x)),  # type: ignore[misc]
            h,
        )
        if x is not None:
            found.append((x, limit))
    return min(found, key=lambda pair: pair[0]) if found else None


def _root(signal: Signal, begin: float, end: float) -> float:
    if signal(begin) == 0.0 or signal(begin) * signal(end) > 0.0:
        return begin
    from scipy.optimize import brentq  # takes 0.4 s, and many runs have no event

    return float(brentq(signal, begin, end, xtol=TIME_TOLERANCE, rtol=1e-15))
