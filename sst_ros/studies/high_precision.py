# SPDX-License-Identifier: Apache-2.0
"""DOP853 with fixed steps beyond double precision: long doubles, or mpmath's numbers.

The integration package runs on doubles, compiled to machine code; this is the one independent
integrator on other number types. It evaluates the same traced program, so that it solves to the
last bit what the methods solve.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.expression import Program
from sst_ros.errors import InputError, Problem
from sst_ros.integration.methods import DOP853

LongArray: TypeAlias = NDArray[np.longdouble]
EXTENDED, MPMATH = "long double", "mpmath"

DIGITS = 30
"""Decimal digits of mpmath's numbers."""


@dataclass(frozen=True)
class NumberType:
    """Numbers to calculate with.

    Attributes:
        name: for reports.
        number: converts a float or an integer.
        functions: elementary functions by the names that programs use.
        back: converts to a long double.

    """

    name: str
    number: Callable[[Any], Any]
    functions: dict[str, Any]
    back: Callable[[Any], Any]


def number_type(name: str) -> NumberType:
    """Return long doubles or mpmath's numbers of 30 digits.

    Raises:
        InputError: mpmath is asked for and not installed.

    """
    names = ("sqrt", "sin", "cos", "tanh", "exp")
    if name == EXTENDED:
        functions = {each: getattr(np, each) for each in names} | {"atan2": np.arctan2}
        return NumberType(f"{np.finfo(np.longdouble).precision}-digit floats",
                          np.longdouble, functions, np.longdouble)  # fmt: skip
    try:
        import mpmath
    except ImportError:
        allowed = "needs mpmath: pip install mpmath"
        raise InputError("accuracy", [Problem("reference", name, allowed)]) from None
    context = mpmath.mp.clone()
    context.dps = DIGITS
    functions = {each: getattr(context, each) for each in (*names, "atan2")}
    return NumberType(f"mpmath, {DIGITS} digits", context.mpf, functions,
                      lambda x: np.longdouble(mpmath.nstr(x, DIGITS)))  # fmt: skip


class HighPrecisionDop853:
    """DOP853 with fixed steps on a number type.

    Args:
        program: derivative with the inputs t, state, drive.
        kind: EXTENDED or MPMATH.
        drive: constant inputs.

    """

    def __init__(self, program: Program, kind: str, drive: Sequence[float]) -> None:
        self.numbers = number_type(kind)
        namespace: dict[str, Any] = dict(self.numbers.functions)
        exec(program.source("rhs"), namespace)
        self._rhs: Callable[..., tuple[Any, ...]] = namespace["rhs"]
        number = self.numbers.number
        self._drive = tuple(map(number, drive))
        self._a = [[(i, number(w)) for i, w in enumerate(row) if w] for row in DOP853.a]
        weights = [number(w) for w in DOP853.b]
        # As doubles they do not quite add up to 1, which no step size would show.
        weights[-1] = number(1) - sum(weights[:-1], number(0))
        self._b = [(i, w) for i, w in enumerate(weights) if DOP853.b[i]]
        self._c = [number(c) for c in DOP853.c]

    def solve(self, start: Sequence[float], interval: float, count: int, steps: int) -> LongArray:
        """Return states at k * interval [s], k = 0 .. count, shape (count + 1, len(start)).

        The first four numbers are a quaternion, which is kept at length 1. A row of nan stands
        where there is no finite state.
        """
        number, back = self.numbers.number, self.numbers.back
        result = np.full((count + 1, len(start)), np.nan, dtype=np.longdouble)
        y = [number(x) for x in start]
        h = number(interval) / steps
        result[0] = [back(x) for x in y]
        with contextlib.suppress(ArithmeticError, ValueError), np.errstate(all="ignore"):
            for k in range(count):
                for step in range(steps):
                    y = self._step((k * steps + step) * h, y, h)
                result[k + 1] = [back(x) for x in y]
        return result

    def evaluate(self, start: Sequence[float]) -> tuple[Any, ...]:
        """Evaluate the derivative once, at time zero: for measuring what it costs."""
        number = self.numbers.number
        return self._rhs(number(0), *map(number, start), *self._drive)

    def _step(self, t: Any, y: list[Any], h: Any) -> list[Any]:
        slopes: list[tuple[Any, ...]] = []
        for row, node in zip(self._a, self._c, strict=True):
            at = [x + h * sum(w * slopes[i][j] for i, w in row) for j, x in enumerate(y)]
            slopes.append(self._rhs(t + node * h, *at, *self._drive))
        new = [x + h * sum(w * slopes[i][j] for i, w in self._b) for j, x in enumerate(y)]
        length = self.numbers.functions["sqrt"](sum(x * x for x in new[:4]))
        return [x / length for x in new[:4]] + new[4:]
