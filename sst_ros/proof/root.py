# SPDX-License-Identifier: Apache-2.0
"""Roots of equations in balls, by the test of Krawczyk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from sst_ros.proof.balls import PRECISION, arb, arb_mat, column, entries, magnitude
from sst_ros.proof.enclosure import Function, Refused

INFLATIONS = 6  # of the box in which the root is looked for


class Root(NamedTuple):
    """Where the unknowns of equations are.

    They are in middle + slopes (parameters - their middles) +- remainder.
    """

    middle: list[Any]
    slopes: Any
    remainder: list[Any]


def krawczyk(
    run: Function, guess: Sequence[float], parameters: Sequence[Any], reason: str
) -> Root:
    """Enclose the root of equations near a guess, for all parameters in balls.

    `run` returns the values of the equations at unknowns and parameters, then their
    derivatives by each. Raises Refused, with the reason, where the root is not proven
    to exist and to be the only one in a box.
    """
    n = len(guess)
    middles = [x.mid() for x in parameters]
    off = column([x - middle for x, middle in zip(parameters, middles, strict=True)])

    def evaluate(unknown: Any, parameter_values: Sequence[Any]) -> tuple[Any, Any, Any]:
        flat = [arb(x) for x in run(*entries(unknown), *parameter_values)]
        rows = [
            [flat[n * (j + 1) + i] for j in range(n + len(parameters))]
            for i in range(n)
        ]
        by_unknown = arb_mat([row[:n] for row in rows])
        return column(flat[:n]), by_unknown, arb_mat([row[n:] for row in rows])

    middle = column([arb(x) for x in guess])
    for _ in range(6):  # Newton
        values, slopes, _ = evaluate(middle, middles)
        inverse = slopes.mid().inv().mid()
        middle = (middle - inverse * values).mid()
    # for all parameters
    values = evaluate(middle, middles)[0] + evaluate(middle, parameters)[2] * off
    step = inverse * values
    least = arb(2) ** (8 - PRECISION)
    reach = entries(magnitude(step))
    for _ in range(INFLATIONS):
        radii = [(2 * x + least).upper() for x in reach]
        box = column([arb(m, r) for m, r in zip(entries(middle), radii, strict=True)])
        _, slopes, by_parameters = evaluate(box, parameters)
        image = middle - step - (inverse * slopes - 1) * (box - middle)
        pairs = zip(entries(box), entries(image), strict=True)
        if all(wide.contains_interior(narrow) for wide, narrow in pairs):
            break
        reach = entries(magnitude(image - middle))
    else:
        raise Refused(reason)
    back = slopes.inv()
    linear = -1 * (back * by_parameters)
    kept = linear.mid()
    remainder = magnitude(back * evaluate(middle, middles)[0]) + magnitude(
        linear - kept
    ) * magnitude(off)
    return Root(entries(middle), kept, entries(remainder))
