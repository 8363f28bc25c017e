# SPDX-License-Identifier: Apache-2.0
"""The motion to some 25 digits: extrapolated midpoint steps (Gragg, Bulirsch, Stoer) in mpmath.

The method and the arithmetic are nobody's who is compared, and two step sizes tell its error. The
right-hand side is the traced program, which the gates hold against the paper and all engines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mpmath as mp

from benchmark.peers.task import DURATION, Pose, Task

SAMPLES = 20
"""The reference is known at the multiples of DURATION / SAMPLES."""

DIGITS, COLUMNS = 32, 11


@dataclass(frozen=True)
class Reference:
    """Poses by sample number 1 .. SAMPLES, and how far two step sizes are apart [rad]."""

    poses: dict[int, Pose]
    error: float


def solved(task: Task, progress: Callable[[int, int], None] = lambda done, of: None) -> Reference:
    """Integrate twice, with steps of DURATION / 20 and / 40."""
    with mp.workdps(DIGITS):
        slope = _slope(task)
        start = [mp.mpf(number) for number in task.start]
        rough = _samples(slope, start, 1, lambda k: progress(k, 3 * SAMPLES))
        fine = _samples(slope, start, 2, lambda k: progress(SAMPLES + 2 * k, 3 * SAMPLES))
        error = max(
            2 * mp.sqrt(sum((a - b) ** 2 for a, b in zip(x[:4], y[:4], strict=True)))
            for x, y in zip(rough, fine, strict=True)
        )
    poses = {k + 1: task.pose_of([float(number) for number in y]) for k, y in enumerate(fine)}
    return Reference(poses, float(error))


def _slope(task: Task) -> Callable[..., Any]:
    names: dict[str, Any] = {name: getattr(mp, name) for name in ("sqrt", "sin", "cos", "tanh")}
    exec(task.system.program.source("rhs"), names)
    function: Callable[..., Any] = names["rhs"]
    return function


def _samples(slope: Any, y: Any, per_sample: int, progress: Callable[[int], None]) -> list[Any]:
    h = mp.mpf(DURATION) / (SAMPLES * per_sample)
    found = []
    for k in range(SAMPLES):
        for j in range(per_sample):
            y = _extrapolated(slope, (k * per_sample + j) * h, h, y)
            length = mp.sqrt(sum(part * part for part in y[:4]))
            y = [part / length for part in y[:4]] + y[4:]
        found.append(y)
        progress(k + 1)
    return found


def _extrapolated(slope: Any, t: Any, h: Any, y: Any) -> Any:
    """One step; column j removes the next power of h^2, so the order is 2 COLUMNS."""
    first = slope(t, *y)
    row: list[Any] = []
    for i in range(COLUMNS):
        new = [_midpoint(slope, t, h, y, first, 2 * (i + 1))]
        for j in range(i):
            factor = mp.mpf((i + 1) ** 2) / (i - j) ** 2 - 1
            new.append([a + (a - b) / factor for a, b in zip(new[j], row[j], strict=True)])
        row = new
    return row[-1]


def _midpoint(slope: Any, t: Any, h: Any, y: Any, first: Any, count: int) -> Any:
    """`count` (even) leapfrog steps of h / count; their error has even powers of h only."""
    x = h / count
    old, now = y, [a + x * b for a, b in zip(y, first, strict=True)]
    for k in range(1, count):
        rate = slope(t + k * x, *now)
        old, now = now, [a + 2 * x * b for a, b in zip(old, rate, strict=True)]
    rate = slope(t + h, *now)
    # Gragg's smoothing keeps the even powers.
    return [(a + b + x * c) / 2 for a, b, c in zip(old, now, rate, strict=True)]


def common(steps: int) -> int:
    """Largest number of equal pieces of the run that steps and samples both have."""
    return math.gcd(steps, SAMPLES)
