# SPDX-License-Identifier: Apache-2.0
"""Peaks of a function of time: sampled, then refined between the samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from sst_ros.mechanism.geometry import Array

_ROUNDING = 1e-13


class Peak(NamedTuple):
    """A value and the time at which it is taken [s]."""

    value: float
    time: float


def maximum(
    function: Callable[[float], float], times: Array, values: Array, floor: float = -math.inf
) -> Peak:
    """Return the maximum of a function of which samples are known.

    Every sample that no neighbour exceeds is a local maximum. It is refined between its neighbours
    if the function could exceed the best sample there: extrapolated by its change to the lower
    neighbour.

    Args:
        function: of time.
        times: of the samples, rising [s], shape (n,).
        values: the function there, shape (n,).
        floor: maxima that are certainly below it are not refined.

    """
    top = int(np.argmax(values))
    best = Peak(float(values[top]), float(times[top]))
    left, right = np.append(-np.inf, values[:-1]), np.append(values[1:], -np.inf)
    below = np.minimum(np.append(values[0], values[:-1]), np.append(values[1:], values[-1]))
    high = 2.0 * values - below > max(best.value + _ROUNDING * abs(best.value), floor)
    summits = (values >= left) & (values >= right) & high
    for index in np.flatnonzero(summits):
        bounds = times[max(index - 1, 0)], times[min(index + 1, len(times) - 1)]
        width = float(bounds[1] - bounds[0])
        found = minimize_scalar(
            lambda time: -function(time), bounds=bounds, method="bounded",
            options={"xatol": 1e-8 * width},
        )  # fmt: skip
        if -found.fun > best.value + _ROUNDING * abs(best.value):
            best = Peak(float(-found.fun), float(found.x))
    return best


def minimum(function: Callable[[float], float], times: Array, values: Array) -> Peak:
    """Return the minimum; see `maximum`."""
    found = maximum(lambda time: -function(time), times, -values)
    return Peak(-found.value, found.time)


def peak_magnitude(function: Callable[[float], float], times: Array, values: Array) -> Peak:
    """Return the value of the largest magnitude, with its sign; see `maximum`."""
    high, low = maximum(function, times, values), minimum(function, times, values)
    return high if high.value >= -low.value else low
