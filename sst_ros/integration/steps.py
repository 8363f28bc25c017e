# SPDX-License-Identifier: Apache-2.0
"""Steps of methods as ordinary functions on numbers of any kind.

They are traced: what is read here is what runs, as plain Python, as machine code, and
in the lanes of a batch, with the same operations in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sst_ros.integration.methods import Tableau
from sst_ros.mechanism.generic_math import Scalar, absolute, larger, sqrt

Derivative = Callable[..., Sequence[Scalar]]
"""Derivative of a state by time, of the time [s] and the numbers of the state."""

_LEAST = 1e-300
"""In place of the square of an estimate that is zero, which divides zero then."""


def explicit_step(
    derivative: Derivative, tableau: Tableau, t: Scalar, h: Scalar, y: Sequence[Scalar]
) -> tuple[list[Scalar], list[Scalar]]:
    """Advance a state by one step of an explicit Runge-Kutta method.

    Args:
        derivative: of the state by time.
        tableau: coefficients of the method.
        t: time at the begin of the step [s].
        h: length of the step [s].
        y: state at the begin of the step.

    Returns:
        The new state, and an estimate of the local error of each of its numbers, zero
        where the method has none.

    """
    slopes: list[Sequence[Scalar]] = []
    for weights, node in zip(tableau.a, tableau.c, strict=True):
        at = _moved(y, h, weights, slopes) if slopes else y
        slopes.append(derivative(t + node * h, *at))
    new = _moved(y, h, tableau.b, slopes)
    errors = [_error_of(tableau, h, [slope[j] for slope in slopes]) for j in range(len(y))]
    return new, errors


def normalise(y: Sequence[Scalar]) -> list[Scalar]:
    """Give the quaternion, the first four numbers of a state, length 1."""
    x, y_part, z, w = y[:4]
    factor = 1.0 / sqrt(x * x + y_part * y_part + z * z + w * w)
    return [*(part * factor for part in y[:4]), *y[4:]]


def _moved(
    y: Sequence[Scalar], h: Scalar, weights: Sequence[float], slopes: Sequence[Sequence[Scalar]]
) -> list[Scalar]:
    """Return y + h * (sum of weights times slopes)."""
    return [
        number + h * _sum_of(weights, [slope[j] for slope in slopes]) for j, number in enumerate(y)
    ]


def _sum_of(weights: Sequence[float], numbers: Sequence[Scalar]) -> Scalar:
    """Sum weights times numbers from left to right, without the weights that are zero."""
    total: Scalar = None
    for weight, number in zip(weights, numbers, strict=True):
        if weight:
            total = weight * number if total is None else total + weight * number
    return 0.0 if total is None else total


def _error_of(tableau: Tableau, h: Scalar, slopes: Sequence[Scalar]) -> Scalar:
    """Estimate the local error of a number from its slopes at the stages."""
    if not tableau.error:
        return 0.0
    fine = _sum_of(tableau.error, slopes)
    if not tableau.damping:
        return h * fine
    # Hairer's estimate for DOP853, each number of the state for itself.
    coarse = _sum_of(tableau.damping, slopes)
    both = fine * fine + 0.01 * (coarse * coarse)
    return h * fine * absolute(fine) / sqrt(larger(both, _LEAST))
