# SPDX-License-Identifier: Apache-2.0
"""Roots of equations in balls, by the test of Krawczyk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from sst_ros.mechanism.generic_math import rows_of
from sst_ros.proof.balls import (
    PRECISION,
    arb,
    column,
    entries,
    from_columns,
    magnitude,
    middles,
)
from sst_ros.proof.enclosure import Function, Refused

# Newton's method doubles the digits in a step: a guess in doubles needs two or three.
ROOT_NEWTON_STEPS = 6
INFLATIONS = 6  # of the box in which the root is looked for
LEAST_RADIUS = 2.0 ** (8 - PRECISION)  # of that box: rounding alone is not wider


class Root(NamedTuple):
    """The unknowns of equations, for all parameters in their balls.

    They lie in middle + slopes (parameters - their middles) +- remainder.
    """

    middle: list[Any]
    slopes: Any
    remainder: list[Any]


class _Linearization(NamedTuple):
    """Equations at unknowns and parameters."""

    values: Any  # a column
    by_unknowns: Any  # a row for each equation
    by_parameters: Any


def krawczyk(
    run: Function, guess: Sequence[float], parameters: Sequence[Any], reason: str
) -> Root:
    """Enclose the root of equations near a guess, for all parameters in balls.

    `run` returns the values of the equations at unknowns and parameters, then their
    derivatives by each. Raises Refused, with the reason, where the root is not proven
    to exist and to be the only one in a box.
    """
    n = len(guess)
    fixed = middles(parameters)
    differences = [x - middle for x, middle in zip(parameters, fixed, strict=True)]
    off = column(differences)

    def linearize(unknowns: Any, parameter_values: Sequence[Any]) -> _Linearization:
        numbers = list(map(arb, run(*entries(unknowns), *parameter_values)))
        values, *slopes = rows_of(numbers, n)
        return _Linearization(
            column(values), from_columns(slopes[:n]), from_columns(slopes[n:])
        )

    root = column(list(map(arb, guess)))
    for _ in range(ROOT_NEWTON_STEPS):
        at_root = linearize(root, fixed)
        inverse = at_root.by_unknowns.mid().inv().mid()
        root = (root - inverse * at_root.values).mid()
    # Newton's step from there, for all parameters.
    residual = linearize(root, fixed).values
    step = inverse * (residual + linearize(root, parameters).by_parameters * off)
    bounds = entries(magnitude(step))
    for _ in range(INFLATIONS):
        box = column(
            [
                arb(middle, (2 * bound + arb(LEAST_RADIUS)).upper())
                for middle, bound in zip(entries(root), bounds, strict=True)
            ]
        )
        in_box = linearize(box, parameters)
        image = root - step - (inverse * in_box.by_unknowns - 1) * (box - root)
        if _contains_interior(box, image):
            break
        bounds = entries(magnitude(image - root))
    else:
        raise Refused(reason)
    back = in_box.by_unknowns.inv()
    slopes = -1 * (back * in_box.by_parameters)
    exact_slopes = slopes.mid()
    remainder = magnitude(back * residual)
    remainder += magnitude(slopes - exact_slopes) * magnitude(off)
    return Root(entries(root), exact_slopes, entries(remainder))


def _contains_interior(box: Any, image: Any) -> bool:
    """Whether a column of balls lies in the interior of another one."""
    for outer, inner in zip(entries(box), entries(image), strict=True):
        if not outer.contains_interior(inner):
            return False
    return True
