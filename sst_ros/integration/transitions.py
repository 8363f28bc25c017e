# SPDX-License-Identifier: Apache-2.0
"""Where Coulomb friction changes its sign, which a step must not leap over.

Friction of the form tanh(v / smoothing) changes within a few times the smoothing rate.
A step that is much longer meets the change with none of its stages, or with one by
chance. Its embedded error estimate is then chance, too, and so is the distance of a
second solution, which leaps over the same change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from sst_ros.scene.scene import Scene

_WIDTH = 2.0
"""Of v / smoothing, that a step may pass at most. tanh has its poles at pi / 2 from the
real axis: steps of this width converge with the order of their method."""
_RESOLVED = 0.1
"""Share of the tolerance that a width exceeds: the local errors of accepted steps alone
would leap over a narrower one, and steps would shrink for ever where a joint sticks."""
_ENTRY = 0.5
"""Share of the width that a step which was shortened passes: rates are not linear."""


class Transition(NamedTuple):
    """The rates of a joint within which its friction changes."""

    rate: int  # place of the joint's rate among nine angles and nine rates
    edge: float  # magnitude from which the friction is constant [rad/s]
    width: float  # part of the range that a step may pass [rad/s]

    def passed(self, begin: Sequence[float], end: Sequence[float]) -> float:
        """Return what lies between two rates, over the width that a step may pass."""
        low, high = sorted((begin[self.rate], end[self.rate]))
        return (min(high, self.edge) - max(low, -self.edge)) / self.width

    def share(self, begin: Sequence[float], end: Sequence[float]) -> float:
        """Return the share of a step after which it has passed a part of the width."""
        before, after = begin[self.rate], end[self.rate]
        approach = max(abs(before) - self.edge, 0.0)
        return (approach + _ENTRY * self.width) / abs(after - before)


def transitions_of(scene: Scene, tolerance: float) -> tuple[Transition, ...]:
    """Return the transitions of the joints of a scene.

    They end where 1 - tanh(x), about 2 exp(-2 x), is below the tolerance. One that is
    narrower than local errors is left out.
    """
    edge = 0.5 * math.log(max(2.0 / tolerance, 1.0))
    if scene.friction is None or edge == 0.0:
        return ()
    kinds = scene.friction.gamma, scene.friction.mu, scene.friction.beta
    return tuple(
        Transition(
            9 + 3 * place + leg,
            edge * friction.smoothing,
            _WIDTH * friction.smoothing,
        )
        for place, friction in enumerate(kinds)
        if friction is not None
        and (friction.coulomb or friction.static)
        and _WIDTH * friction.smoothing >= _RESOLVED * tolerance
        for leg in range(3)
    )


def largest_passed(
    transitions: Sequence[Transition], begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return the largest part of a width that a step passes; above 1 it leaps."""
    return max((each.passed(begin, end) for each in transitions), default=0.0)


def share_before_leap(
    transitions: Sequence[Transition], begin: Sequence[float], end: Sequence[float]
) -> float:
    """Return the share of a step that leaps by which it does not."""
    return min(
        each.share(begin, end) for each in transitions if each.passed(begin, end) > 1.0
    )
