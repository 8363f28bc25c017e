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
from collections.abc import Iterable, Iterator, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Any

from sst_ros.errors import refuse_other_rounding, require

_flint = require("flint")
arb = _flint.arb
arb_mat = _flint.arb_mat
arb_poly = _flint.arb_poly
arb_series = _flint.arb_series
ctx = _flint.ctx

PRECISION = 128  # bits of all balls
LONGEST_SERIES = 100  # coefficients of a series, at most
PERCENT = 2  # exponent of ten
# python-flint has one context for all threads, so one proof runs at a time.
_CONTEXT_LOCK = threading.RLock()


@contextlib.contextmanager
def precision() -> Iterator[None]:
    """Compute with PRECISION bits and long series, one thread at a time.

    Raises InputError where the processor does not round to nearest: the arithmetic of
    Python between the balls is specified for that alone.
    """
    refuse_other_rounding("certify")
    with _CONTEXT_LOCK:
        old_precision = ctx.prec
        old_cap = ctx.cap
        ctx.prec = PRECISION
        ctx.cap = LONGEST_SERIES
        try:
            yield
        finally:
            ctx.prec = old_precision
            ctx.cap = old_cap


def number_ball(number: float, text: str | None = None) -> Any:
    """Return a ball of a number as it is read and as it is written.

    Reading rounds to nearest, so the two are at most half a unit in the last place
    apart.
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
    """Write a number to some significant digits, rounded up."""
    return _write(number, digits, ROUND_CEILING)


def write_down(number: float, digits: int = 12) -> str:
    """Write a number to some significant digits, rounded down."""
    return _write(number, digits, ROUND_FLOOR)


def percent_up(share: float, digits: int) -> str:
    """Write a share in percent, rounded up."""
    return f"{_write(share, digits, ROUND_CEILING, PERCENT)} %"


def percent_down(share: float, digits: int) -> str:
    """Write a share in percent, rounded down."""
    return f"{_write(share, digits, ROUND_FLOOR, PERCENT)} %"


def degrees_up(angle: float, digits: int) -> str:
    """Write an angle [rad] in degrees, rounded up."""
    with precision():
        return f"{write_up(upper(arb(angle) * 180 / arb.pi()), digits)} deg"


def _write(number: float, digits: int, rounding: str, exponent: int = 0) -> str:
    """Write number * 10**exponent to some significant digits, rounded once."""
    if not math.isfinite(number):
        return str(number)
    rounded = Context(prec=digits, rounding=rounding).create_decimal(Decimal(number))
    if exponent:
        # Both operations are exact. Adding 0 makes 100 out of 1E+2.
        rounded = rounded.scaleb(exponent) + 0
    text = f"{rounded:.{digits}g}"
    assert Decimal(text) == rounded
    if "." in text and "e" not in text:
        text = text.rstrip("0").rstrip(".")
    return text


def between(low: Any, high: Any) -> Any:
    """Return a ball of all numbers between two."""
    return arb(low).union(arb(high))


def around_zero(bounds: Iterable[Any]) -> list[Any]:
    """Return the balls of all numbers whose absolute values have upper bounds."""
    return [arb(0, bound.upper()) for bound in bounds]


def middles(numbers: Iterable[Any]) -> list[Any]:
    """Return the middles of balls, as exact numbers."""
    return [x.mid() for x in numbers]


def radii(numbers: Iterable[Any]) -> list[Any]:
    """Return the radii of balls, as exact numbers."""
    return [x.rad() for x in numbers]


def norm(numbers: Sequence[Any]) -> Any:
    """Return the root of the sum of squares.

    The ball of a sum that may be zero has negative numbers, too, which have no root.
    """
    total = inner_product(numbers, numbers)
    if total > 0:
        return total.sqrt()
    return between(0, total.upper().max(arb(0)).sqrt())


def inner_product(left: Sequence[Any], right: Sequence[Any]) -> Any:
    """Return the sum of the products of two rows of numbers."""
    total = arb(0)
    for x, y in zip(left, right, strict=True):
        total = total + x * y
    return total


def column(numbers: Sequence[Any]) -> Any:
    """Return a matrix of one column."""
    return arb_mat([[x] for x in numbers])


def from_columns(columns: Sequence[Sequence[Any]]) -> Any:
    """Return a matrix of columns."""
    return arb_mat([list(row) for row in zip(*columns, strict=True)])


def identity(n: int) -> Any:
    """Return the identity matrix of n rows."""
    return zeros(n) + 1


def zeros(n: int) -> Any:
    """Return the matrix of n rows and n columns of zeros."""
    return arb_mat(n, n, [0] * (n * n))


def magnitude(matrix: Any) -> Any:
    """Return upper bounds of the absolute values of the entries, as exact numbers."""
    return arb_mat([[x.abs_upper() for x in row] for row in matrix.tolist()])


def entries(matrix: Any) -> list[Any]:
    """Return the numbers of a matrix, row by row."""
    numbers: list[Any] = matrix.entries()
    return numbers
