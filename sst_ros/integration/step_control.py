# SPDX-License-Identifier: Apache-2.0
"""Control of the step size, and the choice between explicit and implicit methods."""

from __future__ import annotations

from sst_ros.integration.compiled_method import Method
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, RODAS4, Rosenbrock
from sst_ros.mechanism.geometry import Array

GROW = 5.0
"""Largest factor by which a step grows."""

_SAFETY, _SHRINK = 0.9, 0.2
_STIFF, _EASY = 2.0, 0.5
"""Step times fastest decay above which an explicit method is left, and step times fastest rate
below which an implicit one is; explicit methods are stable to about 3."""


def step_factor(error: float, error_order: int) -> float:
    """Factor for the next step after one with a local error, relative to the tolerance."""
    if error == 0.0:
        return GROW
    if not error < float("inf"):
        return _SHRINK
    return float(min(max(_SAFETY * error ** (-1.0 / (error_order + 1)), _SHRINK), GROW))


def better_method(
    method: Method, tolerance: float, steps: Array, *, only_stiff: bool
) -> tuple[Method, str]:
    """Choose the method that would take longer steps, and state why.

    Args:
        method: the one in use, which is the choice where none is better.
        tolerance: largest local error estimate of a step.
        steps: length of a step times the eigenvalues of the Jacobian.
        only_stiff: look for stiffness alone.

    """
    radius, decay = abs(steps).max(), -steps.real.min()
    implicit = isinstance(method, Rosenbrock)
    if not implicit and decay > _STIFF and decay > 0.5 * radius:
        return RODAS4, f"stiff: step times fastest decay is {decay:.2g}"
    if only_stiff:
        return method, ""
    if implicit and radius < _EASY:
        return DORMAND_PRINCE, f"no longer stiff: step times rate is {radius:.2g}"
    if method is DORMAND_PRINCE and tolerance < 1e-7 and decay <= _STIFF:
        return DOP853, "many small steps that accuracy asks for"
    return method, ""
