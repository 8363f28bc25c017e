# SPDX-License-Identifier: Apache-2.0
"""Enclosures of the solution of y' = f(t, y), step by step, in ball arithmetic.

In a step p is a polynomial, d = p' - f(t, p) its defect, and e = y - p. With J between p and y

    e' = J(s) e - d,    so    e(s) = V(s) e(0) + w(s),    w' = J w + (J V - V') e(0) - d,

where the polynomial matrix V is nearly a fundamental matrix. The logarithmic norm of J bounds w.
All holds while e stays inside of a box, which is checked afterwards: what e cannot leave, it never
leaves. Sets are e(0) = C a + B b with boxes a, what the motion began with, and b, all later errors.
B follows V; where it becomes skew its axes are made orthogonal (Lohner 1987). p, V, B, the norm and
the steps may be any numbers: they are found in whatever arithmetic, and then taken as exact. All
that is proven is computed in Arb's balls, whose rounding is outward.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from operator import methodcaller
from typing import Any, NamedTuple, NoReturn

import numpy as np

from sst_ros.errors import require
from sst_ros.programs.expression import FUNCTIONS, Program

_flint = require("flint")
arb, arb_mat, arb_poly, arb_series, ctx = (
    getattr(_flint, name) for name in ("arb", "arb_mat", "arb_poly", "arb_series", "ctx")
)
Function = Callable[..., Sequence[Any]]

PRECISION, LONGEST = 128, 100  # bits; coefficients of a series
J_ORDER, V_ORDER = 8, 16  # of the Jacobian and of V
AHEAD = 4  # coefficients of the Jacobian that p is found by
SKEW = 1e4  # condition of the axes of a set beyond which they are made orthogonal
GROWTH = 0.05  # of a set by the remainder of V, largest in a step
UNBOUNDED = "a number is not bounded: a singularity may be near"
LEAST = 1e-9  # of a step, relative to the whole time: the proof ends


class Refused(ArithmeticError):
    """A step is not proven: how much shorter, or in what wider tube, it may be."""

    def __init__(self, reason: str, shorter: float = 0.5, wider: list[Any] | None = None) -> None:
        super().__init__(reason)
        self.shorter, self.wider = shorter, wider


@contextlib.contextmanager
def precision() -> Iterator[None]:
    """Compute with PRECISION bits, and long series."""
    before, ctx.prec, ctx.cap = (ctx.prec, ctx.cap), PRECISION, LONGEST
    try:
        yield
    finally:
        ctx.prec, ctx.cap = before


def upper(x: Any) -> float:
    """Return a float that is not less than a ball."""
    value = arb(x).upper()
    found = float(value)
    return found if value <= found else math.nextafter(found, math.inf)


def between(low: Any, high: Any) -> Any:
    """Return a ball of all numbers between two."""
    return arb(low).union(arb(high))


def norm(numbers: Sequence[Any]) -> Any:
    """Return the root of the sum of squares."""
    return sum((x * x for x in numbers), arb(0)).sqrt()


def column(numbers: Sequence[Any]) -> Any:
    """Return a matrix of one column."""
    return arb_mat([[x] for x in numbers])


def magnitude(matrix: Any) -> Any:
    """Return upper bounds of the absolute values of the entries, as exact numbers."""
    return arb_mat([[x.abs_upper() for x in row] for row in matrix.tolist()])


def entries(matrix: Any) -> list[Any]:
    """Return the numbers of a matrix, row by row."""
    return [x for row in matrix.tolist() for x in row]


def _middles(matrix: Any) -> np.ndarray[Any, Any]:
    return np.array([[float(x.mid()) for x in row] for row in matrix.tolist()])


# Functions of balls and of series of balls, and programs on them.


def _first(x: Any) -> Any:
    return x[0] if isinstance(x, arb_series) else x


def _tanh(x: Any) -> Any:
    return 1 - 2 / ((2 * x).exp() + 1)


def _atan2(y: Any, x: Any) -> Any:
    angle = arb.atan2(arb(_first(y)), arb(_first(x)))
    if not isinstance(y, arb_series) and not isinstance(x, arb_series):
        return angle
    y, x = arb_series(y), arb_series(x)
    return ((y.derivative() * x - x.derivative() * y) / (x * x + y * y)).integral() + angle


class _Kink:
    """What may be on both sides of a kink: nothing is known of it, but that zero times it is zero.

    So is the damping of an elastic stop that is not touched.
    """

    def __mul__(self, other: Any) -> Any:
        numbers = other.coeffs() if isinstance(other, arb_series) else [other]
        # A ball around zero is neither == 0 nor != 0.
        return arb(0) if all(not isinstance(x, _Kink) and x == 0 for x in numbers) else self

    __rmul__ = __mul__

    def refuse(self, *_: object) -> NoReturn:
        raise Refused("a kink: a contact begins or ends, or a torque meets its limit")

    __add__ = __radd__ = __sub__ = __rsub__ = __neg__ = refuse
    __truediv__ = __rtruediv__ = __arb__ = refuse


def _step(x: Any) -> Any:
    value = _first(x)
    known = not isinstance(value, _Kink) and (value > 0 or value < 0)
    return int(bool(value > 0)) if known else _Kink()


def cut(x: Any, _zero: float = 0.0) -> Any:
    """Return x where x > 0 and 0 elsewhere, or what may be both."""
    side = _step(x)
    return side if isinstance(side, _Kink) else x * side


_ON_BALLS: dict[str, Callable[..., Any]] = {name: methodcaller(name) for name in FUNCTIONS}
_ON_BALLS |= {"tanh": _tanh, "atan2": _atan2, "max": cut, "step": _step}


def compile_on_balls(program: Program, constants: Sequence[Any]) -> Function:
    """Turn a program into a function of balls or series, with these values of its last inputs."""
    count = len(program.inputs) - len(constants)
    before, after, results = program.split(range(count))
    names = _ON_BALLS | dict(zip(program.inputs[count:], constants, strict=True))
    before, after = (
        [re.sub(r"\(1\.0 if (.+) > 0\.0 else 0\.0\)", r"step(\1)", line) for line in lines]
        for lines in (before, after)
    )
    exec("\n".join(before), names)
    lines = [f"def function({', '.join(program.inputs[:count])}):", *after]
    exec("\n    ".join([*lines, f"return ({', '.join(results)},)"]), names)
    function: Function = names["function"]
    return function


def _series(polynomial: Any, size: int) -> Any:
    return arb_series(polynomial.coeffs()[:size], size)


def _coefficients(x: Any, size: int) -> list[Any]:
    if isinstance(x, _Kink):
        x.refuse()
    found = x.coeffs() if isinstance(x, arb_series) else [arb(x)]
    return [*found, *[arb(0)] * size][:size]


# Sets, and what a step proves.


class Region(NamedTuple):
    """Where the solution is at a time: centre + C a + B b with |a_i| and |b_i| bounded."""

    time: float
    centre: list[Any]  # exact
    c: Any
    a: Any
    axes: Any  # B
    b: Any

    @classmethod
    def box(cls, time: float, balls: Sequence[Any]) -> Region:
        """Return the region of all that lies in balls."""
        n = len(balls)
        one, zero = arb_mat(n, n, [0] * (n * n)) + 1, column([0] * n)
        return cls(time, [x.mid() for x in balls], one, column([x.rad() for x in balls]), one, zero)

    def spread(self, by: Any = 1) -> Any:
        """Bound each number of by e."""
        return magnitude(by * self.c) * self.a + magnitude(by * self.axes) * self.b


class Advance(NamedTuple):
    """A step: the solution is p(s) + V(s) e(0) + w, with |w_i| bounded, from begin to end."""

    begin: Region
    end: float
    p: list[Any]  # polynomials
    tube: list[Any]  # balls of e in the whole step
    defect: float = 0.0  # largest integral of |d_i|, not rounded outward
    v: Sequence[Any] = ()  # coefficients of V
    w: Any = None
    weights: Sequence[Any] = ()  # of a norm in which the numbers of e are alike

    @property
    def length(self) -> Any:
        """Length [s], exact."""
        return arb(self.end) - arb(self.begin.time)

    @property
    def half(self) -> Any:
        """Half of the length [s]."""
        return self.length / 2

    def flow(self, s: Any) -> Any:
        """Return V(s)."""
        return sum((v * s**k for k, v in enumerate(self.v[1:], 1)), self.v[0])

    def at(self, time: float, by: Any = 1) -> tuple[list[Any], list[Any]]:
        """Return p at a time [s], and bounds of the numbers of by e."""
        s = arb(time) - arb(self.begin.time)
        w = magnitude(by * self.v[0]) * self.w
        return [p(s) for p in self.p], entries(magnitude(self.begin.spread(by * self.flow(s)) + w))

    def expand(self, function: Function, where: Any, size: int, tube: Sequence[Any]) -> list[Any]:
        """Coefficients below `size` of a function of t and y = p + e at s = where, e in `tube`."""
        rows = (p(arb_poly([where, 1])) + e for p, e in zip(self.p, tube, strict=True))
        time = arb_series([arb(self.begin.time) + where, 1], size)
        found = function(time, *(_series(row, size) for row in rows))
        return [_coefficients(x, size) for x in found]

    def enclose(
        self,
        function: Function,
        order: int,
        tube: Sequence[Any],
        span: tuple[Any, Any] | None = None,
        parts: int = 1,
    ) -> list[list[Any]]:
        """Coefficients of polynomials about the middle of a span that enclose a function in it.

        The last one is what it is anywhere in the span: Lagrange's remainder. The span counts from
        the begin of the step [s], and is all of it by default.
        """
        begin, end = span or (arb(0), self.length)
        part = (end - begin) / parts
        found = self.expand(function, (begin + end) / 2, order, tube)
        spans = [between(begin + k * part, begin + (k + 1) * part) for k in range(parts)]
        last = [self.expand(function, one, order + 1, tube) for one in spans]
        return [
            [*row, reduce(arb.union, (one[i][order] for one in last))]
            for i, row in enumerate(found)
        ]


def shift(coefficients: Sequence[Any], by: Any) -> list[Any]:
    """Return the coefficients of a polynomial about another point."""
    every = range(len(coefficients))
    return [
        sum((coefficients[j] * (math.comb(j, k) * by ** (j - k)) for j in every[k + 1 :]), c)
        for k, c in enumerate(coefficients)
    ]


def approximate(f: Function, jacobian: Function, at: Region, order: int) -> list[list[Any]]:
    """Return the coefficients of p.

    A series f(t, p) gives the next coefficient of p, and nearly those that follow: what they add
    to it is linear, by the Jacobian on what was known.
    """
    n, p, j = len(at.centre), [[x] for x in at.centre], list[Any]()

    def run(function: Function, size: int) -> list[list[Any]]:
        found = function(arb_series([at.time, 1], size), *(arb_series(row, size) for row in p))
        return [_coefficients(x, size) for x in found]

    while (known := len(p[0])) <= order:
        if known == AHEAD:
            j = _matrices(run(jacobian, AHEAD)[n:], n)
        slopes, new = run(f, min(known + len(j), order)), list[Any]()
        for k in range(known - 1, len(slopes[0])):
            added = (j[k - i] * x for i, x in enumerate(new, known))
            slope = sum(added, column([row[k] for row in slopes]))
            new.append((slope / (k + 1)).mid())
        for row, more in zip(p, zip(*map(entries, new), strict=True), strict=True):
            row += more
    return p


def _matrices(flat: Sequence[Sequence[Any]], n: int) -> list[Any]:
    """Return the coefficients of a Jacobian, from those of its entries column by column."""
    rows = [[flat[n * c + r] for c in range(n)] for r in range(n)]
    return [arb_mat([[x[k] for x in row] for row in rows]) for k in range(len(flat[0]))]


def bound_defect(f: Function, step: Advance, order: int) -> list[list[Any]]:
    """Return bounds of coefficients of the defect about the middle; `order` is that of p."""
    found = step.enclose(f, order, [arb(0)] * len(step.p), parts=2)
    slopes = [p.derivative()(arb_poly([step.half, 1])) for p in step.p]
    d = [
        [(x - slope[k]).abs_upper() for k, x in enumerate(row)]
        for row, slope in zip(found, slopes, strict=True)
    ]
    if not all(x.is_finite() for row in d for x in row):  # max() of Python would skip a nan
        raise Refused(UNBOUNDED)
    return d


def prove(f: Function, jacobian: Function, step: Advance, order: int, tolerance: float) -> Advance:
    """Prove a step with e in its tube, or raise Refused; `order` is that of p."""
    n, h, half = len(step.p), step.length, step.half
    s, u = between(0, h), between(-half, half)  # from the begin, from the middle
    d = bound_defect(f, step, order)
    step = step._replace(defect=max(2 * float(arb_poly(row).integral()(half)) for row in d))
    if not (excess := step.defect / tolerance) <= 1.0:
        shorter = 0.9 * excess ** (-1.0 / order) if excess < math.inf else 0.5
        raise Refused("the defect is too large", max(shorter, 0.2))
    j = _matrices(step.enclose(jacobian, J_ORDER, step.tube)[n:], n)
    middles, v = shift([_middles(x) for x in j], -float(half)), [np.eye(n)]
    for k in range(V_ORDER):
        some = range(min(k, J_ORDER) + 1)
        v.append(np.sum([middles[i] @ v[k - i] for i in some], axis=0) / (k + 1))
    step = step._replace(v=[arb_mat(matrix.tolist()) for matrix in v])
    about, zero = shift(step.v, half), arb_mat(n, n, [0] * (n * n))
    rest = zero  # J V - V' in the whole step
    for k in reversed(range(J_ORDER + V_ORDER + 1)):
        some = range(max(0, k - V_ORDER), min(k, J_ORDER) + 1)
        term = sum((j[i] * about[k - i] for i in some), zero)
        rest = rest * u + (term - about[k + 1] * (k + 1) if k < V_ORDER else term)
    source = entries(step.begin.spread(rest))
    whole = reduce(lambda found, matrix: found * u + matrix, reversed(j))
    size, weights = magnitude(whole), _weights(whole)
    growth, largest = arb(0), arb(0)  # logarithmic norm of J; norm of (J V - V') e(0)
    for i in range(n):
        others = sum((size[i, k] * weights[k] for k in range(n) if k != i), arb(0))
        growth = growth.max((whole[i, i] + others / weights[i]).upper())
        largest = largest.max((source[i] / weights[i]).upper())
    most = largest * h  # integral of the norm of both, which is no less than the norm of it
    for k in range(order + 1):
        sizes = [(row[k] / x).upper() for row, x in zip(d, weights, strict=True)]
        most += 2 * max(sizes) * half ** (k + 1) / (k + 1)
    w = [((growth * h).exp() * most * x).upper() for x in weights]
    step = step._replace(w=column(w), weights=weights)
    reached = entries(step.begin.spread(step.flow(s)) + step.w)
    if all(x.is_finite() and x < e.rad() for x, e in zip(reached, step.tube, strict=True)):
        return step
    widest, grows = max(map(float, entries(step.begin.spread()))), max(map(float, w))
    slow = grows < 10.0 * tolerance + GROWTH * widest
    wider = [arb(0, (2 * x).upper()) for x in reached] if slow else None
    raise Refused("the error may leave the tube: it grows too fast", 0.6, wider)


def _weights(jacobian: Any) -> list[Any]:
    """Return weights of a norm in which |J| is small: nearly its Perron vector."""
    size, found = np.abs(_middles(jacobian)), np.ones(len(jacobian.tolist()))
    if not np.all(np.isfinite(size)):
        raise Refused(UNBOUNDED)
    for _ in range(20):
        found = size @ found + 1e-3 * found
        found = np.maximum(found / found.max(), 1e-9)
    return [arb(x) for x in found.tolist()]


def region_at_end(step: Advance) -> Region:
    """Return where the solution is at the end of a step, in axes that fit it."""
    h, here = step.length, step.begin
    flow, reached = step.flow(h), [p(h) for p in step.p]
    moved, c = flow * here.axes, flow * here.c
    error = magnitude(c - c.mid()) * here.a + step.w + column([x.rad() for x in reached])
    scale = np.array([[float(x)] for x in step.weights])
    guide = _middles(moved) / scale
    guide /= np.linalg.norm(guide, axis=0)
    if not np.linalg.cond(guide) < SKEW:
        guide = _middles(moved) / scale * np.array([list(map(float, entries(here.b)))])
        guide = np.linalg.qr(guide[:, np.argsort(-np.linalg.norm(guide, axis=0))])[0]
    axes = arb_mat((scale * guide).tolist())
    back = axes.inv()
    b = magnitude(magnitude(back * moved) * here.b + magnitude(back) * error)
    return Region(step.end, [x.mid() for x in reached], c.mid(), here.a, axes, b)


def _tube(here: Region, room: int, tolerance: float) -> list[Any]:
    return [arb(0, (room * (x + tolerance)).upper()) for x in entries(here.spread())]


def enclose(
    f: Function, jacobian: Function, here: Region, end: float, tolerance: float, order: int
) -> Iterator[Advance]:
    """Yield proven steps from a region to a time [s]; Refused says why one cannot be proven.

    Args:
        f: derivative of the time and each number of the state, as series.
        jacobian: f, then its derivatives by each number of the state.
        here: where the solution begins.
        end: time [s].
        tolerance: what the defect may add to an error in a step; `order` is that of p.
        order: degree of p.

    """
    factor, usual, most, room = 0.4, end - here.time, math.inf, 3
    least = LEAST * usual
    while here.time < end:
        p = approximate(f, jacobian, here, order)
        sizes = [(k, max(float(row[k].abs_upper()) for row in p)) for k in (order - 1, order)]
        longest = min([(tolerance / x) ** (1.0 / k) for k, x in sizes if x], default=usual)
        h, tries = min(factor * longest, 2.0 * usual, most), 0
        tube = _tube(here, room, tolerance)
        while True:
            target = end if here.time + 1.01 * h > end else here.time + h
            try:
                step = Advance(here, target, list(map(arb_poly, p)), tube)
                step = prove(f, jacobian, step, order, tolerance)
                break
            except (ArithmeticError, ValueError) as error:
                why = error if isinstance(error, Refused) else Refused(UNBOUNDED)
                if why.wider is not None and tries < 4:
                    tube, tries, room = why.wider, tries + 1, min(2 * room, 100)
                    continue
                h, tries, most, room = why.shorter * (target - here.time), 0, 0.0, 3
                tube = _tube(here, room, tolerance)
                if h < least or here.time + h == here.time:
                    raise why from None
        yield step
        taken = target - here.time
        if target < end:
            usual, most = max(taken, 0.1 * usual), 1.1 * taken if most < math.inf else most
            ratio = (0.5 * tolerance / step.defect) ** (1.0 / order) if step.defect else 1.3
            factor = taken / longest * min(max(ratio, 0.7), 1.3)
        here = region_at_end(step)
