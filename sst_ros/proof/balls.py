# SPDX-License-Identifier: Apache-2.0
"""Balls of Arb: numbers of documents, outward rounding to floats and text, a lock.

A number of a document stands for the decimal number that is written and for the double
that it is read as: its ball holds both. A number that Python code gives stands for the
double and for the shortest decimal number that is read as it.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Any

from sst_ros.errors import refuse_other_rounding, require

_flint = require("flint")
arb, arb_mat, arb_poly, arb_series, ctx = (
    getattr(_flint, name)
    for name in ("arb", "arb_mat", "arb_poly", "arb_series", "ctx")
)

PRECISION = 128  # bits of all balls
LONGEST_SERIES = 100  # coefficients of a series, at most
PERCENT = 2  # exponent of ten
_CONTEXT_LOCK = threading.RLock()
"""python-flint has one context for all threads, so one proof runs at a time."""


@contextlib.contextmanager
def precision() -> Iterator[None]:
    """Compute with PRECISION bits and long series, one thread at a time.

    Raises InputError where the processor does not round to nearest: the arithmetic of
    Python between the balls is specified for that alone.
    """
    refuse_other_rounding("certify")
    with _CONTEXT_LOCK:
        before = ctx.prec, ctx.cap
        ctx.prec, ctx.cap = PRECISION, LONGEST_SERIES
        try:
            yield
        finally:
            ctx.prec, ctx.cap = before


def number_ball(number: float, text: str | None = None) -> Any:
    """Return a ball of a number as it is read and as it is written.

    Reading rounds to nearest, so the two are half a unit in the last place apart at
    most.
    """
    if Decimal(text or repr(number)) == Decimal(number):
        return arb(number)
    return arb(number, 0.5 * math.ulp(number))


def half_unit(text: str) -> Any:
    """Return half a unit of the last digit of a number that is written as text."""
    exponent = Decimal(text).as_tuple().exponent
    assert isinstance(exponent, int)
    return arb(10) ** exponent / 2


def upper(x: Any) -> float:
    """Return a float that is not less than a ball."""
    value = arb(x).upper()
    nearest = float(value)
    return nearest if value <= nearest else math.nextafter(nearest, math.inf)


def lower(x: Any) -> float:
    """Return a float that is not greater than a ball."""
    return -upper(-arb(x))


def write_up(number: float, digits: int = 2) -> str:
    """Write a bound with some significant digits, none of them less than it."""
    return _write(number, digits, ROUND_CEILING)


def write_down(number: float, digits: int = 12) -> str:
    """Write a number with some significant digits, none of them greater than it."""
    return _write(number, digits, ROUND_FLOOR)


def percent_up(share: float, digits: int) -> str:
    """Write a share in percent, not less than it."""
    return f"{_write(share, digits, ROUND_CEILING, PERCENT)} %"


def percent_down(share: float, digits: int) -> str:
    """Write a share in percent, not greater than it."""
    return f"{_write(share, digits, ROUND_FLOOR, PERCENT)} %"


def degrees_up(angle: float, digits: int) -> str:
    """Write an angle [rad] in degrees, not less than it."""
    with precision():
        return f"{write_up(upper(arb(angle) * 180 / arb.pi()), digits)} deg"


def _write(number: float, digits: int, rounding: str, exponent: int = 0) -> str:
    """Write a number times ten to an exponent; it is rounded once."""
    if not math.isfinite(number):
        return str(number)
    rounded = Context(prec=digits, rounding=rounding).create_decimal(Decimal(number))
    if exponent:
        rounded = rounded.scaleb(exponent) + 0  # exact; 100, not 1E+2
    text = f"{rounded:.{digits}g}"
    assert Decimal(text) == rounded
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


def between(low: Any, high: Any) -> Any:
    """Return a ball of all numbers between two."""
    return arb(low).union(arb(high))


def norm(numbers: Sequence[Any]) -> Any:
    """Return the root of the sum of squares.

    The ball of a sum that may be zero has negative numbers, too, which have no root.
    """
    total = sum((x * x for x in numbers), arb(0))
    if total > 0:
        return total.sqrt()
    return between(0, total.upper().max(arb(0)).sqrt())


def column(numbers: Sequence[Any]) -> Any:
    """Return a matrix of one column."""
    return arb_mat([[x] for x in numbers])


def magnitude(matrix: Any) -> Any:
    """Return upper bounds of the absolute values of the entries, as exact numbers."""
    return arb_mat([[x.abs_upper() for x in row] for row in matrix.tolist()])


def entries(matrix: Any) -> list[Any]:
    """Return the numbers of a matrix, row by row."""
    return [x for row in matrix.tolist() for x in row]
