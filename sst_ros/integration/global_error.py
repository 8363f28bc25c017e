# SPDX-License-Identifier: Apache-2.0
"""Global error of a run, by a second solution: a coarse one in a control loop, a finer one else.

In a loop a coarse solution takes steps of twice the length (Richardson extrapolation): its distance
tends to 2^order - 1 times the error of the run as steps shrink, and costs half a step. A motion of
`simulate` is followed by steps of half the length, which cost twice a step and assume no order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sst_ros.integration.adaptive_stepper import Step
from sst_ros.integration.compiled_method import Point
from sst_ros.scene.scene import Scene

_ROUNDING = 64 * 2.220446049250313e-16

_SHARP, _SLIDING = 10.0, 5.0
"""A step loses its order where a rate changes by 10 times the smoothing of a Coulomb torque, at
rates below 5 times; RK4 resolves less sharp ones within the accuracy of the estimate."""


class ErrorGrowth(NamedTuple):
    """How the distance of the two solutions has grown.

    Attributes:
        coulomb: joints with Coulomb friction (0 to 8, by kind and leg), and its smoothing [rad/s],
            where fixed steps may step over its sign change.
        lost, total: growth of the distance of the body rates in steps of order 1, and in all.

    """

    coulomb: tuple[tuple[int, float], ...] = ()
    lost: float = 0.0
    total: float = 0.0

    def after(self, at: Point, end: Point) -> ErrorGrowth:
        """Add a step from `at` to `end`."""
        if not self.coulomb:
            return self
        old, new = ([a - b for a, b in zip(x.y[4:7], x.z[4:7], strict=True)] for x in (at, end))
        grown = math.dist(old, new)
        lost = grown if self._steps_over_sign_change(at, end) else 0.0
        return ErrorGrowth(self.coulomb, self.lost + lost, self.total + grown)

    def _steps_over_sign_change(self, at: Point, end: Point) -> bool:
        for joint, smoothing in self.coulomb:
            v, w = at.joints[joint + 9], end.joints[joint + 9]
            nearest = 0.0 if v * w < 0.0 else min(abs(v), abs(w))
            if abs(w - v) > _SHARP * smoothing and nearest < _SLIDING * smoothing:
                return True
        return False

    def errors(self, at: Point, steps: int) -> tuple[float, float]:
        """Estimated global errors of orientation [rad] and body rate [rad/s] after some steps.

        Twice the asymptotic value: at loose tolerances the terms of higher order hide a part of it.
        """
        y, z = at.y, at.z
        apart = orientation_distance(y, z), math.dist(y[4:7], z[4:7])
        rounding = _ROUNDING * math.sqrt(steps + 1.0)
        share = max(2.0 / (2.0**at.order - 1.0), self.lost / self.total if self.lost else 0.0)
        scale = (1.0, max(1.0, math.hypot(*y[4:7])))
        first, second = (
            max(d * share, min(d, rounding * s)) for d, s in zip(apart, scale, strict=True)
        )
        return first, second


def orientation_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Angle between the orientations of two states that are near [rad]; q and -q are the same."""
    return 2.0 * min(math.dist(y[:4], z[:4]), math.dist(y[:4], [-x for x in z[:4]]))


def coulomb_joints(scene: Scene) -> Iterator[tuple[int, float]]:
    """Yield joints with Coulomb friction (0 to 8, by kind and leg), and its smoothing [rad/s]."""
    if scene.friction is not None:
        kinds = scene.friction.gamma, scene.friction.mu, scene.friction.beta
        for kind, friction in enumerate(kinds):
            if friction is not None and (friction.coulomb or friction.static):
                yield from ((3 * kind + k, friction.smoothing) for k in range(3))


_MARGIN = 2.0
"""Of the distance: an error that halves with the steps is twice as large."""
_FLOOR = 8 * 2.220446049250313e-16


class HalvedSteps:
    """A second solution, which goes through each step of a run by two of half the length.

    No order is assumed, as none holds where a torque jumps, a clamp or a contact bends the motion,
    or friction is sharp. The steps halve where the run's own steps are, whatever chose them. Where
    the method has its order, the second solution is nearly exact, and the distance is the error;
    where each step loses its order, the error halves, and the distance is half of the error.

    Args:
        start: where the run begins.

    Attributes:
        steps: how many steps of the run it has gone through.

    """

    def __init__(self, start: Point) -> None:
        self._y, self.steps = list(start.y), 0

    def add(self, step: Step) -> None:
        """Go through a step of the run, which is itself a pair of steps."""
        method, h = step.method, (step.t + step.h) - step.t  # between its ends, which are rounded
        self.steps += 1
        try:
            self._y = method.step_fixed(step.t, 0.25 * h, 4, self._y, step.drive)
        except (ArithmeticError, ValueError):
            self._y = [math.nan] * len(self._y)

    def error(self, y: list[float]) -> float:
        """Estimated error of the orientation of the run at y [rad]."""
        floor = _FLOOR * math.sqrt(self.steps + 1.0)
        return max(_MARGIN * orientation_distance(y, self._y), floor)
