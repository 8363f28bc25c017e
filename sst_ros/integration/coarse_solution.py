# SPDX-License-Identifier: Apache-2.0
"""Global error by Richardson extrapolation: a coarse solution takes steps of twice the length.

Its distance from the solution tends to 2^order - 1 times the error of the solution as steps shrink.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

_ROUNDING = 64 * 2.220446049250313e-16

Vector = Sequence[float]


def errors(
    y: Vector, coarse: Vector, order: int, steps: int, first_order: float = 0.0
) -> tuple[float, float]:
    """Estimated global errors of orientation [rad] and body rate [rad/s] after `steps` steps.

    `first_order` is the part, 0 to 1, of the distance that comes from steps of order 1.

    Twice the asymptotic value: at loose tolerances the terms of higher order hide a part of it.
    """
    same = math.dist(y[:4], coarse[:4])
    opposite = math.dist(y[:4], [-x for x in coarse[:4]])  # q and -q are the same rotation
    apart = (2.0 * min(same, opposite), math.dist(y[4:7], coarse[4:7]))
    rounding = _ROUNDING * math.sqrt(steps + 1.0)
    share = max(2.0 / (2.0**order - 1.0), first_order)
    scale = (1.0, max(1.0, math.hypot(*y[4:7])))
    first, second = (
        max(d * share, min(d, rounding * s)) for d, s in zip(apart, scale, strict=True)
    )
    return first, second


def rate_growth(before: tuple[Vector, Vector], after: tuple[Vector, Vector]) -> float:
    """Change over a step of the difference of the body rates [rad/s]."""
    old, new = ([a - b for a, b in zip(*pair, strict=True)][4:7] for pair in (before, after))
    return math.dist(old, new)


def rescaled(y: Vector, coarse: Vector, order: int, new: int) -> list[float]:
    """Move the coarse solution so that with a method of order `new` it means the same error."""
    if order == new:
        return coarse if isinstance(coarse, list) else list(coarse)
    grow = (2.0**new - 1.0) / (2.0**order - 1.0)
    return [a + grow * (b - a) for a, b in zip(y, coarse, strict=True)]
