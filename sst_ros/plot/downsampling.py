# SPDX-License-Identifier: Apache-2.0
"""Long curves drawn with few points: of every stretch the least and the largest value stay.

No spike is lost, and a gap (nan) stays a gap; what is left out no picture could show.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.time_series import Integers

STRETCHES = 700
"""Each gives two points or more: a picture is about a thousand pixels wide."""


def envelope(curves: Iterable[Array], count: int) -> Integers:
    """Rows that stay of curves of `count` values each: ascending, the first and the last in it."""
    size = -(-count // STRETCHES)
    if size <= 4:
        return np.arange(count)
    stay = np.zeros(count, dtype=bool)
    stay[[0, -1]] = True
    begins = np.arange(0, count, size)
    for curve in curves:
        padded = np.full(len(begins) * size, np.nan)
        padded[:count] = curve
        stretches = padded.reshape(-1, size)
        lost = np.isnan(stretches)
        for filled in (np.where(lost, -np.inf, stretches), -np.where(lost, np.inf, stretches)):
            stay[np.minimum(begins + filled.argmax(axis=1), count - 1)] = True
        gaps = lost.any(axis=1)
        stay[np.minimum(begins + lost.argmax(axis=1), count - 1)[gaps]] = True
    return np.flatnonzero(stay)


def few(seconds: Array, values: Array) -> tuple[Array, Array]:
    """Return times (m,) and values (m,) or (m, k) with no more points than can be seen."""
    rows = envelope(values.T if values.ndim > 1 else [values], len(values))
    return seconds[rows], values[rows]
