# SPDX-License-Identifier: Apache-2.0
"""Arithmetic on any kind of number: functions beyond + - * /, 3-vectors, rotations.

Floats use `math`; anything else brings the function as a method of its own type (traced
expressions) or through NumPy (columns, complex numbers) or mpmath.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

Scalar = Any
Triple = tuple[Scalar, Scalar, Scalar]
Quadruple = tuple[Scalar, Scalar, Scalar, Scalar]
Rows = tuple[Triple, Triple, Triple]
Symmetric = tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]

ARRAYS = (np.ndarray, np.generic, complex)


def _function_of(name: str) -> Callable[[Any], Any]:
    """Return a function of one number: that of `math`, or of the number's own kind."""
    of_float: Callable[[float], float] = getattr(math, name)

    def of_any(x: Any) -> Any:
        if type(x) is float:
            return of_float(x)
        return _apply_by_kind(name, x)

    return of_any


sqrt = _function_of("sqrt")
exp = _function_of("exp")
log = _function_of("log")
sin = _function_of("sin")
cos = _function_of("cos")


def positive(x: Any) -> Any:
    """Return x where x > 0 and 0 elsewhere.

    Of a complex number the real part decides.
    """
    if type(x) is float:
        return x if x > 0.0 else 0.0
    if hasattr(x, "apply"):
        return x.apply("positive")
    if isinstance(x, ARRAYS):
        return np.where(np.real(x) > 0, x, 0.0)
    return max(x, 0)


def absolute(x: Any) -> Any:
    """Return the absolute value of a real number."""
    return x.apply("abs") if hasattr(x, "apply") else abs(x)


def larger(x: Any, y: Any) -> Any:
    """Return the larger of two real numbers; x where they are equal or y is nan."""
    if type(x) is float and type(y) is float:
        return y if y > x else x
    for number in (x, y):
        if hasattr(number, "apply"):
            return number.apply("max", x, y)
    return np.where(y > x, y, x)


def select(condition: Any, x: Any, y: Any) -> Any:
    """Return x where the condition is > 0, and y elsewhere."""
    if type(condition) is float:
        return x if condition > 0.0 else y
    if hasattr(condition, "apply"):
        return condition.apply("select", condition, x, y)
    return np.where(condition > 0.0, x, y)


def atan2(y: Any, x: Any) -> Any:
    """Angle of the point (x, y); of complex numbers its continuation near the reals."""
    if type(y) is float and type(x) is float:
        return math.atan2(y, x)
    for number in (y, x):
        if hasattr(number, "apply"):
            return number.apply("atan2", y, x)
    if np.iscomplexobj(y) or np.iscomplexobj(x):
        angle = np.arctan2(np.real(y), np.real(x))
        cosine, sine = np.cos(angle), np.sin(angle)
        return angle + np.arctan((y * cosine - x * sine) / (x * cosine + y * sine))
    return _apply_by_kind("atan2", y, x)


LN_2 = (float.fromhex("0x1.62e42fefa2p-1"), float.fromhex("0x1.9ef35793c7673p-41"))
"""ln 2 as a sum. The first part has 13 zeros at its end: its product with a whole
number below 2^13 is exact.
"""

TO_WHOLE = 1.5 * 2.0**52
"""A double as large has no fraction: to add and subtract it rounds to an integer."""

_EXPM1_SERIES = tuple(
    tuple(1.0 / math.factorial(n) for n in range(first, first + 4))
    for first in (2, 6, 10)
)
"""Coefficients of the exponential series from r^2 to r^13, in rows of four.

For abs(r) <= ln(2) / 2 the terms that follow are less than 2e-17 of the sum.
"""

_TANH_IS_ONE = 22.0
"""From here on tanh is 1 to all digits of a double."""


def tanh(x: Any) -> Any:
    """Hyperbolic tangent; of floats by `tanh_steps`."""
    if type(x) is float:
        return tanh_steps(x)
    return _apply_by_kind("tanh", x)


def tanh_steps(x: Scalar) -> Scalar:
    """Hyperbolic tangent by arithmetic alone, within 2.6 units in the last place.

    A function of libm takes one number and branches, and its bits differ between
    machines. These steps have no branch, so the lanes of a register take them together,
    and their bits are the same everywhere.

    With k whole and abs(r) <= ln(2) / 2,

        exp(-2 abs(x)) - 1 = 2^k (exp(r) - 1) + (2^k - 1) = t,  -2 abs(x) = k ln(2) + r,
        tanh(abs(x)) = -t / (t + 2).
    """
    size = absolute(x)
    exponent = -2.0 * select(size - _TANH_IS_ONE, _TANH_IS_ONE, size)
    k = (exponent * (1.0 / math.log(2.0)) + TO_WHOLE) - TO_WHOLE
    ln_2, remainder = LN_2
    r = (exponent - k * ln_2) - k * remainder
    square = r * r
    fourth = square * square
    # Pairs of pairs: half of the operations do not wait for each other.
    sums = []
    for c0, c1, c2, c3 in _EXPM1_SERIES:
        sums.append((c0 + c1 * r) + square * (c2 + c3 * r))
    low, middle, high = sums
    series = (low + fourth * middle) + (fourth * fourth) * high
    scale = power_of_two(k)
    t = scale * (r + square * series) + (scale - 1.0)
    negative = t / (t + 2.0)
    return select(x, -negative, negative)


def power_of_two(k: Scalar) -> Scalar:
    """Return 2^k for a whole number k between -1000 and 1000."""
    if isinstance(k, float):  # NumPy's own, too
        return math.ldexp(1.0, int(k)) if math.isfinite(k) else math.nan
    return k.apply("power_of_two")


def _apply_by_kind(name: str, *arguments: Any) -> Any:
    """Apply a function to traced expressions, NumPy's numbers or those of mpmath."""
    first = arguments[0]
    if hasattr(first, "apply"):
        return first.apply(name)
    if isinstance(first, (*ARRAYS, int)):
        numpy_name = "arctan2" if name == "atan2" else name
        return getattr(np, numpy_name)(*arguments)
    import mpmath

    return getattr(mpmath, name)(*arguments)


def rotation_rows(q: Quadruple) -> Rows:
    """Rows of R for a quaternion (x, y, z, w) of any length > 0."""
    x, y, z, w = q
    s = 2.0 / (x * x + y * y + z * z + w * w)
    sx = s * x
    sy = s * y
    sz = s * z
    xx = sx * x
    yy = sy * y
    zz = sz * z
    xy = sx * y
    xz = sx * z
    yz = sy * z
    wx = sx * w
    wy = sy * w
    wz = sz * w
    return (
        (1.0 - (yy + zz), xy - wz, xz + wy),
        (xy + wz, 1.0 - (xx + zz), yz - wx),
        (xz - wy, yz + wx, 1.0 - (xx + yy)),
    )


def quaternion_product(a: Quadruple, b: Quadruple) -> Quadruple:
    """Product of quaternions (x, y, z, w): first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by + ay * bw + az * bx - ax * bz,
        aw * bz + az * bw + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def quaternion_rate(q: Quadruple, rate: Triple) -> tuple[Scalar, ...]:
    """Differentiate a quaternion (x, y, z, w) by time at the body rate W [rad/s]."""
    x, y, z, w = q
    wx, wy, wz = rate
    return (
        0.5 * (w * wx + y * wz - z * wy),
        0.5 * (w * wy + z * wx - x * wz),
        0.5 * (w * wz + x * wy - y * wx),
        -0.5 * (x * wx + y * wy + z * wz),
    )


def add(a: Triple, b: Triple) -> Triple:
    """Return a + b."""
    ax, ay, az = a
    bx, by, bz = b
    return (ax + bx, ay + by, az + bz)


def multiply(factor: Scalar, a: Triple) -> Triple:
    """Return factor a."""
    x, y, z = a
    return (factor * x, factor * y, factor * z)


def subtract(a: Triple, b: Triple) -> Triple:
    """Return a - b."""
    ax, ay, az = a
    bx, by, bz = b
    return (ax - bx, ay - by, az - bz)


def axpy(alpha: Scalar, a: Triple, beta: Scalar, b: Triple) -> Triple:
    """Return alpha a + beta b."""
    ax, ay, az = a
    bx, by, bz = b
    return (alpha * ax + beta * bx, alpha * ay + beta * by, alpha * az + beta * bz)


def triple(numbers: Iterable[Scalar]) -> Triple:
    """Return three numbers as a triple."""
    first, second, third = numbers
    return (first, second, third)


def rows_of(numbers: Sequence[Any], size: int) -> list[Any]:
    """Divide numbers into rows of `size` numbers."""
    return [numbers[k : k + size] for k in range(0, len(numbers), size)]


def symmetric_rows(matrix: Symmetric) -> Rows:
    """Rows of a symmetric matrix (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = matrix
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def solve_symmetric(matrix: Symmetric, right: Triple) -> Triple:
    """Solve a positive definite system (xx, yy, zz, xy, xz, yz) by L D L^T."""
    xx, yy, zz, xy, xz, yz = matrix
    fx, fy, fz = right
    l21 = xy / xx
    l31 = xz / xx
    d2 = yy - l21 * xy
    e32 = yz - l31 * xy
    l32 = e32 / d2
    d3 = zz - l31 * xz - l32 * e32
    y2 = fy - l21 * fx
    y3 = fz - l31 * fx - l32 * y2
    x3 = y3 / d3
    x2 = y2 / d2 - l32 * x3
    return (fx / xx - l21 * x2 - l31 * x3, x2, x3)


def transform(rows: Rows, vector: Triple) -> Triple:
    """Return the matrix with these rows times a vector.

    With the rows of R it turns a vector of {E} into {B}; with the axes of a frame it
    gives the components along them.
    """
    return triple(dot3(row, vector) for row in rows)


def rotate_back(rows: Rows, vector: Triple) -> Triple:
    """Return the transpose of the matrix with these rows times a vector.

    With the rows of R it turns a vector of {B} into {E}; with the axes of a frame it
    makes a vector of its components along them.
    """
    x, y, z = vector
    first, second, third = rows
    columns = zip(first, second, third, strict=True)
    return triple(x * a + y * b + z * c for a, b, c in columns)


def dot3(a: Triple, b: Triple) -> Scalar:
    """Scalar product of two triples."""
    ax, ay, az = a
    bx, by, bz = b
    return ax * bx + ay * by + az * bz


def cross3(a: Triple, b: Triple) -> Triple:
    """Vector product of two triples."""
    ax, ay, az = a
    bx, by, bz = b
    return (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
