# SPDX-License-Identifier: Apache-2.0
"""Where inside a step a distance, or the push of an end, runs out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from scipy.optimize import brentq

from sst_ros.dynamics.limits import Limit

Signal = Callable[[float], float]
Meeting = tuple[Limit, Signal, Signal]
"""What is met, a signal that becomes negative there, and the rate of the signal."""

TIME_TOLERANCE = 1e-15
"""Accuracy of a located time [s], above the rounding of the time itself."""

GRAZING = 1e-12


def first_crossing(margin: Signal, slope: Signal, h: float) -> float | None:
    """Time x in [0, h] at which `margin` becomes negative, or None.

    Both signals are smooth functions of the time since the step began and `slope` is the rate of
    `margin`. A dip below zero and back inside the step is found where the slope changes sign once.
    A margin that starts at zero and grows does not count, one that starts at zero and shrinks does.
    """
    begin, end = 0.0, h
    rising, falling = slope(0.0) > 0.0, slope(h) < 0.0
    if margin(0.0) <= GRAZING:
        if not rising:
            leaves = slope(0.0) < 0.0 or margin(h) < -GRAZING  # from rest, the latter
            return 0.0 if margin(0.0) < -GRAZING or leaves else None
        if margin(h) >= 0.0 or (margin(h) >= -GRAZING and not falling):
            return None
        # It grew first: the crossing lies behind the top.
        begin = _root(slope, 0.0, h) if falling else 0.0
    elif margin(h) >= 0.0:
        if rising or falling:
            return None
        end = _root(slope, 0.0, h)
        if margin(end) >= 0.0:
            return None
    return _root(margin, begin, end)


def meetings(limits: Iterable[Limit], joints: Callable[[float], Sequence[float]]) -> list[Meeting]:
    """Distances to limits, and their rates, where `joints` are those at a time."""

    def meeting(limit: Limit) -> Meeting:
        return limit, lambda x: limit.margin(joints(x)), lambda x: limit.slope(joints(x))

    return [meeting(limit) for limit in limits]


def first_met(signals: Iterable[Meeting], h: float) -> tuple[float, Limit] | None:
    """Return when in [0, h] the first signal becomes negative, and its limit."""
    met = []
    for limit, margin, slope in signals:
        x = first_crossing(margin, slope, h)
        if x is not None:
            met.append((x, limit))
    return min(met, key=lambda pair: pair[0]) if met else None


def _root(signal: Signal, begin: float, end: float) -> float:
    if signal(begin) == 0.0 or signal(begin) * signal(end) > 0.0:
        return begin
    return float(brentq(signal, begin, end, xtol=TIME_TOLERANCE, rtol=1e-15))
