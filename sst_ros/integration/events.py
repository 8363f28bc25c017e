# SPDX-License-Identifier: Apache-2.0
"""Events inside a step: a joint reaches a limit, or meets or leaves an elastic stop.

The force of a stop has a kink where contact begins and ends, so steps end there.

Friction of the form tanh(v / smoothing) changes its sign within a few times the
smoothing rate. A step that is much longer meets the change with none of its stages, or
with one by chance. Its embedded error estimate is then chance, too, and so is the
distance of a second solution, which leaps over the same change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from sst_ros.dynamics.model import CONTACT_BAND, GRAZING, Limit, Transition
from sst_ros.mechanism.generic_math import Scalar, absolute, larger, select
from sst_ros.state import JOINT_COUNT

Signal = Callable[[float], float]
Joints = Callable[[float], Sequence[float]]
"""Angles and rates of the joints at a time in a step [s]."""
JointRanges = tuple[tuple[int, float, float], ...]
"""A joint, and the least and largest angle inside of all its limits [rad]."""

TIME_TOLERANCE = 1e-15
"""Accuracy of a located time [s], above the rounding of the time itself."""
_REACH = 10.0
"""Most that a joint whose rate has turned goes, over what its rates allow."""
_ENTRY = 0.5
"""Share of the width that a step which was shortened passes: rates are not linear."""


def largest_overshoot(
    ranges: JointRanges, h: Scalar, begin: Sequence[Scalar], end: Sequence[Scalar]
) -> Scalar:
    """Return a number that is negative where no joint can have reached a limit.

    None has in a step where all are inside their range at both ends, and each that has
    turned is farther from its limits than its rates would take it in ten times h.

    Args:
        ranges: of the joints.
        h: length of the step [s].
        begin: joints at its begin, numbers of any kind; `end` alike.
        end: joints at its end.

    """
    largest: Scalar = -1.0
    for joint, least, most in ranges:
        before = begin[joint + JOINT_COUNT]
        after = end[joint + JOINT_COUNT]
        fastest = larger(absolute(before), absolute(after))
        has_turned = -(before * after)
        reach = select(has_turned, _REACH * h * fastest, 0.0)
        for angle in (begin[joint], end[joint]):
            if least > -math.inf:
                largest = larger(largest, least + reach - angle)
            if most < math.inf:
                largest = larger(largest, angle + reach - most)
    return largest


def may_occur(event: Limit, begin: Sequence[float], end: Sequence[float]) -> bool:
    """Test cheaply whether an event may lie in a step, given the joints at both ends.

    A limit counts where the step starts on it; a contact that the step starts on does
    not.
    """
    before = event.distance(begin)
    if event.error is not None:
        if before <= 0.0:
            return True
    elif before <= GRAZING:
        # It starts on the contact: only a joint that first leaves it may meet it again.
        is_leaving = before > -CONTACT_BAND and event.slope(begin) > 0.0
        if not is_leaving:
            return False
    return event.distance(end) < 0.0 or event.slope(begin) < 0.0 < event.slope(end)


def first_crossing(distance: Signal, slope: Signal, h: float) -> float | None:
    """Time x in [0, h] at which `distance` becomes negative, or None.

    Both signals are smooth functions of the time since the step began and `slope` is
    the rate of `distance`. A dip below zero and back inside the step is found where the
    slope changes sign once. A distance that starts at zero counts if it shrinks, and
    not if it grows.
    """
    begin = 0.0
    end = h
    rising = slope(0.0) > 0.0  # at the begin
    falling = slope(h) < 0.0  # at the end
    if distance(0.0) <= GRAZING:
        if not rising:
            is_outside = distance(0.0) < -GRAZING
            shrinks = slope(0.0) < 0.0
            # A joint at rest has no slope yet: it counts where it ends outside.
            ends_outside = distance(h) < -GRAZING
            if is_outside or shrinks or ends_outside:
                return 0.0
            return None
        if distance(h) >= 0.0 or (distance(h) >= -GRAZING and not falling):
            return None
        if falling:  # it grew first: the crossing lies behind the maximum
            begin = _root(slope, 0.0, h)
    elif distance(h) >= 0.0:
        if rising or falling:
            return None
        end = _root(slope, 0.0, h)
        if distance(end) >= 0.0:
            return None
    return _root(distance, begin, end)


def first_event(
    limits: Iterable[Limit], joints: Joints, h: float
) -> tuple[float, Limit] | None:
    """Return the time in [0, h] and the limit of the first event, None without one."""
    first: tuple[float, Limit] | None = None
    for limit in limits:
        x = first_crossing(
            partial(_evaluate, limit.distance, joints),
            partial(_evaluate, limit.slope, joints),
            h,
        )
        if x is not None and (first is None or x < first[0]):
            first = (x, limit)
    return first


def _evaluate(signal: Callable[[Any], float], joints: Joints, x: float) -> float:
    return signal(joints(x))


def _root(signal: Signal, begin: float, end: float) -> float:
    """Return where a signal is zero; `begin` where its sign does not change."""
    if signal(begin) == 0.0 or signal(begin) * signal(end) > 0.0:
        return begin
    from scipy.optimize import brentq  # takes 0.4 s, and many runs have no event

    return float(brentq(signal, begin, end, xtol=TIME_TOLERANCE, rtol=1e-15))


def largest_passed(
    transitions: Sequence[Transition], begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return the largest part of a width that a step passes; above 1 it leaps."""
    largest = 0.0
    for transition in transitions:
        largest = max(largest, _passed(transition, begin, end))
    return largest


def share_before_leap(
    transitions: Sequence[Transition], begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return the share that a step which leaps is shortened to, so as not to leap."""
    return min(
        _share(transition, begin, end)
        for transition in transitions
        if _passed(transition, begin, end) > 1.0
    )


def _passed(
    transition: Transition, begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return how much of a transition a step passes, over what it may pass.

    The transition is the range of rates from -edge to +edge; the number is negative
    where the step stays outside.
    """
    low, high = sorted((begin[transition.rate], end[transition.rate]))
    overlap = min(high, transition.edge) - max(low, -transition.edge)
    return overlap / transition.width


def _share(
    transition: Transition, begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return the share of a step after which it has passed a part of the width."""
    before = begin[transition.rate]
    after = end[transition.rate]
    approach = max(abs(before) - transition.edge, 0.0)
    return (approach + _ENTRY * transition.width) / abs(after - before)
