# SPDX-License-Identifier: Apache-2.0
"""Global error of a run, as its distance from a second solution by steps of half the length.

No order is assumed, as no order holds where a torque jumps, a clamp or a contact bends the motion,
or friction is sharp. The steps halve where the run's own steps are, whatever chose them. Where the
method has its order, the second solution is nearly exact, and the distance is the error; where
each step loses its order, the error halves, and the distance is half of the error.
"""

from __future__ import annotations

import math

from sst_ros.integration.coarse_solution import Point
from sst_ros.integration.evaluation_budget import EvaluationBudget
from sst_ros.integration.propagator import Passage

_MARGIN = 2.0
"""Of the distance: an error that halves with the steps is twice as large."""
_ROUNDING = 8 * 2.220446049250313e-16


class HalvedSteps:
    """A second solution, which goes through each step of a run by two of half the length.

    Args:
        start: where the run begins.
        budget: counts the evaluations.

    Attributes:
        steps: how many steps of the run it has gone through.

    """

    def __init__(self, start: Point, budget: EvaluationBudget) -> None:
        self._y, self._budget, self.steps = list(start.y), budget, 0

    def add(self, step: Passage) -> None:
        """Go through a step of the run, which is itself a pair of steps."""
        method = step.method
        self._budget.charge(4 * method.pair_cost // 3)
        self.steps += 1
        try:
            self._y = method.step_fixed(step.t, 0.25 * step.h, 4, self._y, step.drive)
        except (ArithmeticError, ValueError):
            self._y = [math.nan] * len(self._y)

    def errors(self, y: list[float]) -> tuple[float, float]:
        """Estimated errors of the orientation [rad] and the body rate [rad/s] of the run, at y."""
        one, other = y[:4], self._y[:4]
        apart = 2.0 * min(math.dist(one, other), math.dist(one, [-x for x in other]))
        rates = math.dist(y[4:7], self._y[4:7])
        floor = _ROUNDING * math.sqrt(self.steps + 1.0)
        scale = max(1.0, math.hypot(*y[4:7]))
        return max(_MARGIN * apart, floor), max(_MARGIN * rates, floor * scale)
