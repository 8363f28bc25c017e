# SPDX-License-Identifier: Apache-2.0
"""Sampled-data theory of a control loop: largest stable bandwidth, error of a hold.

**Bandwidth.** Exact computed torque leaves a double integrator for each axis, x'' = u,
and asks for u = -(omega^2 x + 2 zeta omega x'). The state is sampled every T, u acts d
samples later and is held for T. With v = T x', u in units of 1 / T^2 and w = omega T,
one period is exactly

    x+ = x + v + u / 2,   v+ = v + u,   u = -(w^2 x + 2 zeta w v), d samples old,

so the loop's poles are the roots of

    z^d (z - 1)^2 + w^2 (z + 1) / 2 + 2 zeta w (z - 1) = 0

and it is stable while all of them lie inside the unit circle. Without delay, Jury's
conditions give w < min(4 zeta, 1 / zeta); with delay, the limit is found in the roots.

**Hold.** Torques are held while the motion wants them to change. A torque tau(t_k + a
T) held from t_k for T lacks, on average over the hold, (1/2 - a) T tau'(t_k): with a =
0, the start of the hold, the plant sees the torque late by T / 2, and the error falls
as T^1. With a = 1/2 that vanishes; what is left is tau'' T^2 / 24 on average, and the
hold's first moment, which moves the plant by T^3 / 12 times tau' in each of 1 / T
periods: the error falls as T^2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

ORDERS = {"start": 1, "middle": 2}
"""Power of the period in the error of feedforward alone, by the instant held."""

_FINEST = 1e-4


def pole(product: float, damping: float, delay: int) -> float:
    """Modulus of the outermost pole.

    `product` is bandwidth x period [rad], delay in samples.
    """
    polynomial = np.zeros(delay + 3)
    polynomial[:3] = (1.0, -2.0, 1.0)
    rate, angle = 2.0 * damping * product, 0.5 * product**2
    polynomial[-2:] += (angle + rate, angle - rate)
    return float(np.abs(np.roots(polynomial)).max())


def stability_limit(damping: float, delay: int) -> float:
    """Largest bandwidth times period [rad] below which every loop is stable."""
    return largest_stable(
        lambda product: pole(product, damping, delay) < 1.0, _FINEST, 1.02
    )


def largest_stable(
    stable: Callable[[float], bool], start: float, factor: float, to: float = 1e-6
) -> float:
    """Go up from `start` by factors until it is not stable; bisect the last one.

    Returns:
        The limit, to the relative accuracy `to`; nan where the start is not stable.

    """
    if not stable(start):
        return math.nan
    low = start
    while stable(low * factor):
        low *= factor
    high = low * factor
    while high > low * (1.0 + to):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def slope(periods: Sequence[float], errors: Sequence[float]) -> float:
    """Power of the period with which errors fall, by least squares.

    Nan for a single one.
    """
    if len(periods) < 2:
        return math.nan
    return float(np.polyfit(np.log(periods), np.log(errors), 1)[0])
