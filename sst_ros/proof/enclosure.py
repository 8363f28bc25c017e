# SPDX-License-Identifier: Apache-2.0
"""Enclosures of the solution of y' = f(t, y), step by step, in ball arithmetic.

In a step p is a polynomial, d = p' - f(t, p) its defect, and e = y - p. With J between
p and y

    e' = J(s) e - d,  so  e(s) = V(s) e(0) + w(s),  w' = J w + (J V - V') e(0) - d,

where the polynomial matrix V is nearly a fundamental matrix. The logarithmic norm of J
bounds w. All holds while e stays inside of a box, which is checked afterwards: what e
cannot leave, it never leaves. Sets are e(0) = C a + B b with boxes a, what the motion
began with, and b, all later errors. B follows V; where it becomes skew its axes are
made orthogonal (Lohner 1987). p, V, B, the norm and the steps may be any numbers: they
are found in whatever arithmetic, and then taken as exact. All that is proven is
computed in Arb's balls, whose rounding is outward.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from itertools import islice
from operator import methodcaller
from typing import Any, NamedTuple, NoReturn

import numpy as np

from sst_ros.programs.expression import MATH_FUNCTIONS, Program, execute
from sst_ros.proof.balls import (
    arb,
    arb_mat,
    arb_poly,
    arb_series,
    between,
    column,
    entries,
    magnitude,
)

Function = Callable[..., Sequence[Any]]

J_ORDER, V_ORDER = 8, 16  # of the Jacobian and of V
KINK_V_ORDER = 4  # of V in a step across a kink
JACOBIAN_TERMS = 4  # coefficients of the Jacobian that p is found by
SKEW = 1e4  # condition of the axes of a set beyond which they are made orthogonal
REMAINDER_GROWTH = 0.05  # of a set by the remainder of V, largest in a step
CUT = "an angle may pass pi, where that of the model jumps"
UNBOUNDED = "a number is not bounded: a singularity may be near"
LEAST_STEP = 1e-9  # of a step, relative to the whole time: the proof ends
TIGHT = 1.1  # room of a tube around what a step was proven to reach
# of a set in a step, relative to it: more is tried to be avoided by shorter steps
LOSS = 1e-4
KINK_STEP = 1e-11  # first step across a kink, relative to the whole time
UNSEEN = 0.01  # share of the tolerance below which a step may widen the set
REGAIN = 1.25  # longest next step by the last one, after a step was refused
KINK_STEPS = 400  # steps across one kink before the proof ends
# of a set in a step across a kink, below which the next is twice as long
KINK_LOSS = 0.02
KINK_HALVINGS = 30  # of the time in which a kink is looked for


class Refused(ArithmeticError):
    """A step is not proven: how much shorter, or in what wider tube, it may be."""

    def __init__(
        self, reason: str, shorter: float = 0.5, wider: list[Any] | None = None
    ) -> None:
        super().__init__(reason)
        self.shorter = shorter
        self.wider = wider


class KinkMet(Refused):
    """A function has a kink, or may have one, in what is looked at."""


def _middles(matrix: Any) -> np.ndarray[Any, Any]:
    return np.array([[float(x.mid()) for x in row] for row in matrix.tolist()])


# Functions of balls and of series of balls, and programs on them.


def _first(x: Any) -> Any:
    return x[0] if isinstance(x, arb_series) else x


def _tanh(x: Any) -> Any:
    """Return tanh(x) by the exponential that is small.

    The widths of a series are multiplied in a division by one with large coefficients.
    """
    if arb(_first(x)).mid() > 0:
        return 2 / ((-2 * x).exp() + 1) - 1
    return 1 - 2 / ((2 * x).exp() + 1)


def _atan2(y: Any, x: Any) -> Any:
    sine, cosine = arb(_first(y)), arb(_first(x))
    if sine.contains(0) and not cosine > 0:
        raise Refused(CUT)
    angle = arb.atan2(sine, cosine)
    if not isinstance(y, arb_series) and not isinstance(x, arb_series):
        return angle
    y, x = arb_series(y), arb_series(x)
    return (
        (y.derivative() * x - x.derivative() * y) / (x * x + y * y)
    ).integral() + angle


class _Kink:
    """What may be on both sides of a kink.

    Nothing is known of it, but that zero times it is zero. So is the damping of an
    elastic stop that is not touched.
    """

    def __mul__(self, other: Any) -> Any:
        numbers = other.coeffs() if isinstance(other, arb_series) else [other]
        # A ball around zero is neither == 0 nor != 0.
        return (
            arb(0)
            if all(not isinstance(x, _Kink) and x == 0 for x in numbers)
            else self
        )

    __rmul__ = __mul__

    def refuse(self, *_: object) -> NoReturn:
        raise KinkMet("a kink: a contact begins or ends, or a torque meets its limit")

    __add__ = __radd__ = __sub__ = __rsub__ = __neg__ = refuse
    __truediv__ = __rtruediv__ = __arb__ = refuse


class _KinkWatch:
    """What decides on which side of a kink a number is in a span of time.

    Its value anywhere in the span is that in the middle and its derivative times the
    time from there (the mean value theorem), which is narrower than its value in
    interval arithmetic. So the values in the middle are noted in the order in which a
    program computes them, then read again.
    """

    def __init__(self) -> None:
        self._middles: list[Any] = []
        # largest time from the middle, where the values are read
        self._reach: Any = None
        self._next = 0

    @contextlib.contextmanager
    def within(self, reach: Any = None) -> Iterator[None]:
        """Note the values in the middle of a span.

        With a reach, use them for times within it.
        """
        global _watch
        before, _watch = _watch, self
        self._reach = reach
        self._next = 0
        if reach is None:
            self._middles.clear()
        try:
            yield
        finally:
            _watch = before

    def narrow(self, x: Any) -> Any:
        """Return the value of a number, narrower where its middle is known."""
        value = _first(x)
        if self._reach is None:
            self._middles.append(value)
            return value
        middle = self._middles[self._next] if self._next < len(self._middles) else value
        self._next += 1
        if (
            isinstance(value, _Kink)
            or isinstance(middle, _Kink)
            or not isinstance(x, arb_series)
        ):
            return value
        if x.prec < 2 or isinstance(slope := x[1], _Kink):
            return value
        moved = middle + slope * between(-self._reach, self._reach)
        return moved if moved.rad() < value.rad() else value


_watch: _KinkWatch | None = None


def _side(x: Any) -> int | None:
    """Return 1 where x > 0, 0 where x < 0, None where neither is known."""
    value = _first(x) if _watch is None else _watch.narrow(x)
    if isinstance(value, _Kink) or not (value > 0 or value < 0):
        return None
    return int(bool(value > 0))


def _is_constant(x: Any) -> bool:
    """Whether a number does not change in time: no series has another coefficient.

    About the middle of a span these coefficients prove nothing of its ends; but
    whatever is enclosed is also expanded about all of the span, where they do.
    """
    if not isinstance(x, arb_series):
        return not isinstance(x, _Kink)
    return x.prec > 1 and all(coefficient == 0 for coefficient in x.coeffs()[1:])


class SideRecord:
    """On which side of zero the numbers of a program were.

    It is kept for another evaluation of the program. A value that jumps there has no
    slope: where a set lies on both sides of the jump, its values in the middle of the
    set must have all of the jump, too.
    """

    def __init__(self) -> None:
        self._sides: list[Any] = []
        self._next: int | None = None

    @contextlib.contextmanager
    def within(self, *, replay: bool) -> Iterator[None]:
        """Note the sides, or take those that were noted."""
        global _record
        before, _record = _record, self
        self._next = 0 if replay else None
        try:
            yield
        finally:
            _record = before

    def side(self, x: Any) -> Any:
        """Return 1, 0 or what is between."""
        if self._next is None:
            self._sides.append(_step_of(x))
            return self._sides[-1]
        self._next += 1
        return self._sides[self._next - 1]


_record: SideRecord | None = None


def _step(x: Any) -> Any:
    """Return the slope of max(x, 0), or 1 where x > 0 and 0 elsewhere."""
    return _step_of(x) if _record is None else _record.side(x)


def _step_of(x: Any) -> Any:
    """Return a slope; on both sides of the kink it is any number from 0 to 1."""
    side = _side(x)
    if side is not None:
        return side
    if isinstance(x, arb) and x.is_zero():
        return 0  # max(x, 0) is zero in all of the set
    return between(0, 1) if _is_constant(x) else _Kink()


def cut(x: Any, _zero: float = 0.0) -> Any:
    """Return x where x > 0 and 0 elsewhere.

    Of a number on both sides, all that may be.
    """
    side = _side(x)
    if side is not None:
        return x * side
    return arb(_first(x)).max(arb(0)) if _is_constant(x) else _Kink()


_ON_BALLS: dict[str, Callable[..., Any]] = {
    name: methodcaller(name) for name in MATH_FUNCTIONS
}
_ON_BALLS |= {"tanh": _tanh, "atan2": _atan2, "max": cut, "step": _step}


def compile_on_balls(program: Program, constants: Sequence[Any]) -> Function:
    """Turn a program into a function of balls or series.

    The constants are the values of its last inputs.
    """
    count = len(program.inputs) - len(constants)
    before, after, results = program.split(range(count))
    names = _ON_BALLS | dict(zip(program.inputs[count:], constants, strict=True))
    before, after = (
        [
            re.sub(r"\(1\.0 if (.+) > 0\.0 else 0\.0\)", r"step(\1)", line)
            for line in lines
        ]
        for lines in (before, after)
    )
    execute("\n".join(before), names)
    lines = [f"def function({', '.join(program.inputs[:count])}):", *after]
    execute("\n    ".join([*lines, f"return ({', '.join(results)},)"]), names)
    function: Function = names["function"]
    return function


def _series(polynomial: Any, size: int) -> Any:
    return arb_series(polynomial.coeffs()[:size], size)


def _coefficients(x: Any, size: int) -> list[Any]:
    """Return the coefficients of a series below `size`, which are known."""
    if isinstance(x, _Kink):
        x.refuse()
    if not isinstance(x, arb_series):
        return [arb(x), *[arb(0)] * (size - 1)]
    if x.prec < size:
        raise Refused(
            "a series is shorter than asked: another thread uses python-flint"
        )
    coefficients = x.coeffs()
    return [*coefficients, *[arb(0)] * size][:size]


# Sets, and what a step proves.


class Region(NamedTuple):
    """Where the solution is at a time: centre + C a + B b.

    All |a_i| and |b_i| are bounded.
    """

    time: float
    centre: list[Any]  # exact
    c: Any
    a: Any
    axes: Any  # B
    b: Any
    fixed: int = 0  # how many of the last numbers never change

    @property
    def moving(self) -> int:
        """How many of the first numbers change."""
        return len(self.centre) - self.fixed

    @classmethod
    def box(cls, time: float, balls: Sequence[Any]) -> Region:
        """Return the region of all that lies in balls."""
        n = len(balls)
        identity = arb_mat(n, n, [0] * (n * n)) + 1
        zero = column([0] * n)
        return cls(
            time,
            [x.mid() for x in balls],
            identity,
            column([x.rad() for x in balls]),
            identity,
            zero,
        )

    @classmethod
    def linear(
        cls,
        time: float,
        centre: Sequence[Any],
        c: Any,
        a: Sequence[Any],
        errors: Sequence[Any],
        fixed: int,
    ) -> Region:
        """Return the region of all centre + C a +- errors, whose numbers are balls."""
        n = len(centre)
        exact = c.mid()
        identity = arb_mat(n, n, [0] * (n * n)) + 1
        widths = column([arb(x).upper() for x in a])
        error_bounds = column([x.rad() for x in centre]) + column(
            [arb(x).abs_upper() for x in errors]
        )
        b = magnitude(magnitude(c - exact) * widths + error_bounds)
        return cls(time, [x.mid() for x in centre], exact, widths, identity, b, fixed)

    def spread(self, by: Any = 1) -> Any:
        """Bound each number of by e."""
        return magnitude(by * self.c) * self.a + magnitude(by * self.axes) * self.b


class Advance(NamedTuple):
    """A step from begin to end: the solution is p(s) + V(s) e(0) + w.

    All |w_i| are bounded.
    """

    begin: Region
    end: float
    p: list[Any]  # polynomials
    tube: list[Any]  # balls of e in the whole step, once proven those that it reaches
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
        return [p(s) for p in self.p], entries(
            magnitude(self.begin.spread(by * self.flow(s)) + w)
        )

    def expand(
        self, function: Function, where: Any, size: int, tube: Sequence[Any]
    ) -> list[Any]:
        """Return coefficients below `size` of a function at s = where.

        It is a function of t and y = p + e, with e in `tube`.
        """
        count = self.begin.moving
        pairs = zip(self.p[:count], tube[:count], strict=True)
        rows = (p(arb_poly([where, 1])) + e for p, e in pairs)
        fixed = (x + e for x, e in zip(self.begin.centre, tube, strict=True))
        time = arb_series([arb(self.begin.time) + where, 1], size)
        series = (_series(row, size) for row in rows)
        expansions = function(time, *series, *islice(fixed, count, None))
        return [_coefficients(x, size) for x in expansions]

    def values(self, function: Function, where: Any, tube: Sequence[Any]) -> list[Any]:
        """Enclose the values of a function at s in `where`.

        It is a function of t and y = p + e, with e in `tube`.
        """
        state = (p(where) + e for p, e in zip(self.p, tube, strict=True))
        return [arb(x) for x in function(arb(self.begin.time) + where, *state)]

    def enclose(
        self,
        function: Function,
        order: int,
        tube: Sequence[Any],
        span: tuple[Any, Any] | None = None,
        span_count: int = 1,
    ) -> list[list[Any]]:
        """Return coefficients of polynomials that enclose a function in a span.

        The polynomials are about the middle of the span. The last coefficient is what
        it is anywhere in the span: Lagrange's remainder. The span counts from the begin
        of the step [s], and is all of it by default.
        """
        begin, end = span or (arb(0), self.length)
        if order == 0:
            return [[x] for x in self.values(function, between(begin, end), tube)]
        span_length = (end - begin) / span_count
        watch = _KinkWatch()
        reach = ((end - begin) / 2).abs_upper()
        with watch.within():
            middle_coefficients = self.expand(function, (begin + end) / 2, order, tube)
        last = []
        for k in range(span_count):
            with watch.within(reach):
                where = between(begin + k * span_length, begin + (k + 1) * span_length)
                last.append(self.expand(function, where, order + 1, tube))
        return [
            [*row, reduce(arb.union, (expansion[i][order] for expansion in last))]
            for i, row in enumerate(middle_coefficients)
        ]


def shift(coefficients: Sequence[Any], by: Any) -> list[Any]:
    """Return the coefficients of a polynomial about another point."""
    every = range(len(coefficients))
    return [
        sum(
            (
                coefficients[j] * (math.comb(j, k) * by ** (j - k))
                for j in every[k + 1 :]
            ),
            c,
        )
        for k, c in enumerate(coefficients)
    ]


def approximate(
    f: Function, jacobian: Function, region: Region, order: int
) -> list[list[Any]]:
    """Return the coefficients of p.

    A series f(t, p) gives the next coefficient of p, and nearly those that follow: what
    they add to it is linear, by the Jacobian on what was known.
    """
    n = len(region.centre)
    p = [[x] for x in region.centre]
    j: list[Any] = []

    def run(function: Function, size: int) -> list[list[Any]]:
        series = (arb_series(row, size) for row in p[: region.moving])
        expansions = function(
            arb_series([region.time, 1], size), *series, *region.centre[region.moving :]
        )
        return [_coefficients(x, size) for x in expansions]

    while (known_count := len(p[0])) <= order:
        if known_count == JACOBIAN_TERMS:
            j = _matrices(run(jacobian, JACOBIAN_TERMS)[n:], n)
        slopes = run(f, min(known_count + len(j), order))
        new: list[Any] = []
        for k in range(known_count - 1, len(slopes[0])):
            added = (j[k - i] * x for i, x in enumerate(new, known_count))
            slope = sum(added, column([row[k] for row in slopes]))
            new.append((slope / (k + 1)).mid())
        for row, new_coefficients in zip(
            p, zip(*map(entries, new), strict=True), strict=True
        ):
            row += new_coefficients
    return p


def _matrices(flat: Sequence[Sequence[Any]], n: int) -> list[Any]:
    """Return the coefficients of a Jacobian.

    Those of its entries are given column by column.
    """
    rows = [[flat[n * c + r] for c in range(n)] for r in range(n)]
    return [arb_mat([[x[k] for x in row] for row in rows]) for k in range(len(flat[0]))]


def bound_defect(f: Function, step: Advance, order: int) -> list[list[Any]]:
    """Return bounds of coefficients of the defect about the middle.

    `order` is that of p, or 0 for a bound of all of it, which holds across kinks.
    """
    values = step.enclose(f, order, [arb(0)] * len(step.p), span_count=2)
    about_middle = arb_poly([step.half, 1])
    d = []
    for p, row in zip(step.p, values, strict=True):
        slope = p.derivative()
        slopes = slope(about_middle) if order else [slope(between(0, step.length))]
        d.append([(x - slopes[k]).abs_upper() for k, x in enumerate(row)])
    # max() of Python would skip a nan
    if not all(x.is_finite() for row in d for x in row):
        raise Refused(UNBOUNDED)
    return d


def prove(
    f: Function,
    jacobian: Function,
    step: Advance,
    order: int,
    tolerance: float,
    *,
    across_kink: bool = False,
) -> Advance:
    """Prove a step with e in its tube, or raise Refused; `order` is that of p.

    Across a kink no derivative by time exists: f and J are enclosed by their values
    alone, with each slope between those of both sides (the mean value theorem of
    Lipschitz functions).
    """
    n = len(step.p)
    j_order, v_order = (0, KINK_V_ORDER) if across_kink else (J_ORDER, V_ORDER)
    defect_order = 0 if across_kink else order
    d = bound_defect(f, step, defect_order)
    step = _measure_defect(step, d, order, math.inf if across_kink else tolerance)
    j = _matrices(step.enclose(jacobian, j_order, step.tube)[n:], n)
    step = step._replace(v=_fundamental(j, step.half, v_order))
    remainder = _remainder(j, step)
    jacobian_in_step = _values_of(j, step.half)
    weights = _weights(jacobian_in_step)
    source = entries(step.begin.spread(remainder))  # of (J V - V') e(0)
    integrals = [x * step.length for x in source]
    for k in range(defect_order + 1):
        for i, row in enumerate(d):
            integrals[i] += 2 * row[k] * step.half ** (k + 1) / (k + 1)
    by_norm = _bound_by_norm(
        jacobian_in_step, weights, source, d[: step.begin.moving], step
    )
    by_number = _bound_by_number(
        jacobian_in_step, integrals[: step.begin.moving], step.length
    )
    w = [x.min(y).upper() for x, y in zip(by_norm, by_number, strict=True)]
    w += [arb(0)] * step.begin.fixed
    step = step._replace(w=column(w), weights=weights)
    return _check_tube(step, tolerance)


def _bound_by_norm(
    jacobian: Any,
    weights: Sequence[Any],
    source: Sequence[Any],
    d: Sequence[Sequence[Any]],
    step: Advance,
) -> list[Any]:
    """Bound w by the logarithmic norm of J, that of what moves."""
    every = range(len(d))
    size = magnitude(jacobian)
    growth = arb(0)  # of J
    largest = arb(0)  # norm of (J V - V') e(0)
    for i in every:
        off_diagonal = sum((size[i, k] * weights[k] for k in every if k != i), arb(0))
        growth = growth.max((jacobian[i, i] + off_diagonal / weights[i]).upper())
        largest = largest.max((source[i] / weights[i]).upper())
    most = largest * step.length  # integral of the norm of both: not less than its norm
    for k in range(len(d[0])):
        sizes = [(d[i][k] / weights[i]).upper() for i in every]
        largest_size = reduce(arb.max, sizes)
        most += 2 * largest_size * step.half ** (k + 1) / (k + 1)
    bound = (growth * step.length).exp() * most
    return [(bound * weights[i]).upper() for i in every]


def _bound_by_number(jacobian: Any, integrals: Sequence[Any], length: Any) -> list[Any]:
    """Bound w number by number, by integrals of what makes it grow.

    |w_i|' <= J_ii |w_i| + sum |J_ik| |w_k| + |g_i|, whose right side grows with all
    w_k, so that |w| <= exp(A h) (integral of |g|) where A bounds |J_ik|, and J_ii from
    0 on.
    """
    every = range(len(integrals))
    size = magnitude(jacobian)
    rates = [[size[i, k] * length for k in every] for i in every]
    for i in every:
        rates[i][i] = jacobian[i, i].upper().max(arb(0)) * length
    grown = arb_mat(rates).exp() * column([x.upper() for x in integrals])
    bounds = [x.upper() for x in entries(grown)]
    return [x if x.is_finite() else arb("inf") for x in bounds]


def _measure_defect(
    step: Advance, d: Sequence[Sequence[Any]], order: int, tolerance: float
) -> Advance:
    """Note the integral of the last term of the defect; Refused: it is too large.

    The terms below it are what the balls of numbers bring, which shorter steps do not
    lessen.
    """
    size = len(d[0])
    last = max(float(row[-1] * step.length**size / size) for row in d)
    step = step._replace(defect=last)
    if not last <= tolerance:
        excess = last / tolerance
        shorter = 0.9 * excess ** (-1.0 / order) if excess < math.inf else 0.5
        raise Refused("the defect is too large", max(shorter, 0.2))
    return step


def _fundamental(j: Sequence[Any], half: Any, order: int) -> list[Any]:
    """Return the coefficients of V about the middle.

    V is nearly a fundamental matrix of J.
    """
    middles = shift([_middles(x) for x in j], -float(half))
    v = [np.eye(len(middles[0]))]
    for k in range(order):
        terms = [middles[i] @ v[k - i] for i in range(min(k, len(j) - 1) + 1)]
        v.append(np.sum(terms, axis=0) / (k + 1))
    return [arb_mat(matrix.tolist()) for matrix in v]


def _remainder(j: Sequence[Any], step: Advance) -> Any:
    """Enclose J V - V' in the whole step."""
    n = len(step.p)
    u = between(-step.half, step.half)
    zero = arb_mat(n, n, [0] * (n * n))
    about_middle = shift(step.v, step.half)
    degree = len(step.v) - 1
    remainder = zero
    for k in reversed(range(len(j) + degree)):
        some = range(max(0, k - degree), min(k, len(j) - 1) + 1)
        term = sum((j[i] * about_middle[k - i] for i in some), zero)
        if k < degree:
            term = term - about_middle[k + 1] * (k + 1)
        remainder = remainder * u + term
    return remainder


def _values_of(j: Sequence[Any], half: Any) -> Any:
    """Enclose the values of a polynomial matrix in the whole step."""
    u = between(-half, half)
    return reduce(lambda partial_sum, matrix: partial_sum * u + matrix, reversed(j))


def _check_tube(step: Advance, tolerance: float) -> Advance:
    """Return a step with the tube that is reached.

    Refused: the error may leave its tube.
    """
    s = between(0, step.length)
    spread = step.begin.spread(step.flow(s))
    reached = entries(spread + step.w)
    pairs = list(zip(reached, step.tube, strict=True))[: step.begin.moving]
    if all(x.is_finite() and x < e.rad() for x, e in pairs):
        return step._replace(tube=[arb(0, x.upper()) for x in reached])
    # Numbers of ranges do not move, but what they move counts from the first step on:
    # at the end of the step, as V in all of a long step is much wider than it is.
    at_end = step.begin.spread(step.flow(step.length))
    widest = max(
        _largest(spread_then, step.begin.moving)
        for spread_then in (step.begin.spread(), at_end)
    )
    grows = max(map(float, entries(step.w)))
    is_slow = grows < 10.0 * tolerance + REMAINDER_GROWTH * widest
    wider = None
    if is_slow:
        moving = [2 * x for x in reached[: step.begin.moving]]
        wider = [arb(0, x.upper()) for x in moving] + step.tube[step.begin.moving :]
    raise Refused("the error may leave the tube: it grows too fast", 0.6, wider)


def _largest(bounds: Any, count: int) -> float:
    """Return the largest of the first bounds of a column."""
    return max(map(float, entries(bounds)[:count]))


def _weights(jacobian: Any) -> list[Any]:
    """Return weights of a norm in which |J| is small: nearly its Perron vector."""
    size = np.abs(_middles(jacobian))
    weights = np.ones(len(jacobian.tolist()))
    if not np.all(np.isfinite(size)):
        raise Refused(UNBOUNDED)
    for _ in range(20):
        weights = size @ weights + 1e-3 * weights
        weights = np.maximum(weights / weights.max(), 1e-9)
    return [arb(x) for x in weights.tolist()]


def region_at_end(step: Advance, *, boxed: bool = False) -> Region:
    """Return where the solution is at the end of a step, in axes that fit it.

    What is `boxed` has the axes of its numbers.
    """
    h = step.length
    start = step.begin
    flow = step.flow(h)
    reached = [p(h) for p in step.p]
    moved = flow * start.axes
    c = flow * start.c
    rounding = column([x.rad() for x in reached])
    error = magnitude(c - c.mid()) * start.a + step.w + rounding
    centre = [x.mid() for x in reached]
    if boxed:
        n = len(centre)
        axes = arb_mat(n, n, [0] * (n * n)) + 1
        b = magnitude(magnitude(moved) * start.b + error)
    else:
        axes = fit_axes(moved, start.b, [float(x) for x in step.weights])
        back = axes.inv()
        b = magnitude(magnitude(back * moved) * start.b + magnitude(back) * error)
    return Region(step.end, centre, c.mid(), start.a, axes, b, start.fixed)


def _loss(step: Advance) -> float:
    """Return how much of the set at the end of a step is new, in the norm of the step.

    What never changes is not new, and its size says nothing of the others.
    """

    def size(spread: Any) -> float:
        rows = zip(entries(spread), step.weights, strict=True)
        return max(float(x / weight) for x, weight in islice(rows, step.begin.moving))

    old = size(step.begin.spread(step.flow(step.length)))
    return size(step.w) / old if old else 0.0


def fit_axes(moved: Any, b: Any, scale: Sequence[float]) -> Any:
    """Return axes for a set moved b: its own, or orthogonal ones.

    Orthogonal ones are taken where its own are skew.
    """
    scales = np.array(scale)[:, None]
    guide = _middles(moved) / scales
    lengths = np.linalg.norm(guide, axis=0)
    is_skew = not np.all(lengths > 0.0)
    if not is_skew:
        is_skew = not np.linalg.cond(guide / lengths) < SKEW
    if is_skew:
        weighted = guide * np.array([list(map(float, entries(b)))])
        order = np.argsort(-np.linalg.norm(weighted, axis=0))
        guide = np.linalg.qr(weighted[:, order])[0]
    else:
        guide = guide / lengths
    return arb_mat((scales * guide).tolist())


def _tube(region: Region, room: float, tolerance: float) -> list[Any]:
    """Return a tube with some room around a region; what never changes needs none."""
    spread = entries(region.spread())
    moving = [room * (x + tolerance) for x in spread[: region.moving]]
    return [arb(0, x.upper()) for x in (*moving, *spread[region.moving :])]


class ProvenSteps:
    """Proven steps from a region to a time [s]; Refused says why one cannot be proven.

    Args:
        f: derivative of the time and each number of the state, as series.
        jacobian: f, then its derivatives by each number of the state.
        start: where the solution begins.
        end: time [s].
        tolerance: what the defect may add to an error in a step.
        order: degree of p.

    """

    def __init__(
        self,
        f: Function,
        jacobian: Function,
        start: Region,
        end: float,
        tolerance: float,
        order: int,
    ) -> None:
        self._f, self._jacobian = f, jacobian
        self._region = start
        self._end = end
        self._tolerance = tolerance
        self._order = order
        self._span = end - start.time
        self._room = 3  # of a tube
        self._factor = 0.4  # of a step by its longest
        # steps: the last, the longest next
        self._usual = self._span
        self._most = math.inf
        self._cruise = self._span  # last step before a kink was near
        self.kinks: list[tuple[float, float]] = []  # spans of time across kinks [s]

    def __iter__(self) -> Iterator[Advance]:
        """Yield the steps."""
        while self._region.time < self._end:
            try:
                step = self._smooth_step()
            except KinkMet as kink:
                yield from self._cross_kink(kink)
                continue
            yield step
            self._region = region_at_end(step)

    def _smooth_step(self) -> Advance:
        """Prove a step of Taylor series.

        KinkMet where one lies ahead within KINK_STEP.
        """
        region = self._region
        tolerance = self._tolerance
        order = self._order
        p = approximate(self._f, self._jacobian, region, order)
        sizes = [
            (k, max(float(row[k].abs_upper()) for row in p)) for k in (order - 1, order)
        ]
        longest = min(
            [(tolerance / x) ** (1.0 / k) for k, x in sizes if x], default=self._usual
        )
        wanted = self._factor * longest
        tries = 0
        h = min(wanted, 4.0 * self._usual, self._most)
        is_free = h == wanted or self._most < math.inf  # no kink has made it short
        tube = _tube(region, self._room, tolerance)
        while True:
            target = region.time + h
            if region.time + 1.01 * h > self._end:
                target = self._end
            step = Advance(region, target, list(map(arb_poly, p)), tube)
            try:
                step = prove(self._f, self._jacobian, step, order, tolerance)
                less_lossy = self._less_lossy(step)
                is_free = is_free and less_lossy.end == step.end
                step = less_lossy
                break
            except KinkMet as kink:
                tube = _tube(region, 3, tolerance)
                self._room = 3
                h = self._clear_length(step._replace(tube=tube))
                is_free = False
                if h < KINK_STEP * self._span or region.time + h == region.time:
                    raise kink from None
            except (ArithmeticError, ValueError) as error:
                why = error if isinstance(error, Refused) else Refused(UNBOUNDED)
                if why.wider is not None and tries < 4:
                    tube = why.wider
                    tries += 1
                    self._room = min(2 * self._room, 100)
                    continue
                h = why.shorter * (target - region.time)
                tries = 0
                self._most = 0.0
                self._room = 3
                tube = _tube(region, self._room, tolerance)
                if h < LEAST_STEP * self._span or region.time + h == region.time:
                    raise why from None
        self._plan(step.end - region.time, longest, step.defect, is_free=is_free)
        return step

    def _less_lossy(self, step: Advance) -> Advance:
        """Return a step, or a shorter one if it widens the set by much less.

        In a stiff contact the Jacobian turns within a step, and its series is what
        widens.
        """
        if not self._is_lossy(step):
            return step
        moving = [TIGHT * x for x in step.tube[: step.begin.moving]]
        tight = [*moving, *step.tube[step.begin.moving :]]
        with contextlib.suppress(ArithmeticError, ValueError):
            step = self._prove(step._replace(tube=tight))
        while self._is_lossy(step):
            h = 0.6 * (step.end - step.begin.time)
            tube = _tube(step.begin, 3, self._tolerance)
            shorter = step._replace(end=step.begin.time + h, tube=tube)
            try:
                shorter = self._prove(shorter)
            except (ArithmeticError, ValueError):
                return step
            if _loss(shorter) > 0.2 * _loss(step):
                return step
            step = shorter
        return step

    def _is_lossy(self, step: Advance) -> bool:
        """Whether a step widens the set by more than its tolerance, and by much."""
        widened = max(map(float, entries(step.w)))
        return widened > UNSEEN * self._tolerance and _loss(step) > LOSS

    def _prove(self, step: Advance) -> Advance:
        return prove(self._f, self._jacobian, step, self._order, self._tolerance)

    def _plan(
        self, taken: float, longest: float, defect: float, *, is_free: bool
    ) -> None:
        """Choose what the next step is made from."""
        if self._region.time + taken >= self._end:
            return
        self._usual = max(taken, 0.1 * self._usual)
        if self._most < math.inf:
            self._most = REGAIN * taken
        if not is_free:
            return
        self._cruise = self._usual
        ratio = (
            (0.5 * self._tolerance / defect) ** (1.0 / self._order) if defect else 1.3
        )
        self._factor = taken / longest * min(max(ratio, 0.7), 1.3)

    def _clear_length(self, step: Advance) -> float:
        """Return how long no kink is near, nearly, by halving a step that has one."""
        low = 0.0
        high = step.end - step.begin.time
        for _ in range(KINK_HALVINGS):
            middle = 0.5 * (low + high)
            try:
                step.enclose(self._f, 2, step.tube, (arb(0), arb(middle)))
                low = middle
            except KinkMet:
                high = middle
            except (ArithmeticError, ValueError):
                high = middle
            if low > 0.9 * high:
                break
        return 0.95 * low

    def _cross_kink(self, kink: KinkMet) -> Iterator[Advance]:
        """Yield steps across a kink, until a step of series is proven.

        Each is twice as long as the one before.
        """
        begin = self._region.time
        h = KINK_STEP * self._span
        factor, cruise = self._factor, self._cruise
        for _ in range(KINK_STEPS):
            step = self._kink_step(h, kink)
            yield step
            self._region = region_at_end(step)
            taken = step.end - step.begin.time
            h = taken * (2.0 if _loss(step) < KINK_LOSS else 0.7)
            if step.end >= self._end:
                break
            self._usual = taken
            self._most = math.inf
            try:
                ahead = self._smooth_step()
            except KinkMet:
                continue
            yield ahead
            self._region = region_at_end(ahead)
            break
        else:
            raise Refused(f"{kink}, for longer than {KINK_STEPS} steps")
        self.kinks.append((begin, step.end))
        self._usual, self._cruise, self._factor = cruise, cruise, factor

    def _kink_step(self, longest: float, kink: KinkMet) -> Advance:
        """Prove a step across a kink by a straight line p."""
        region = self._region
        h = longest
        for _ in range(KINK_HALVINGS):
            target = min(self._end, region.time + h)
            if target == region.time:
                break
            half = (arb(target) - arb(region.time)) / 2
            time = arb(region.time)
            first = self._f(time, *region.centre)
            middle = [
                x + half * arb(slope).mid()
                for x, slope in zip(region.centre, first, strict=True)
            ]
            slopes = self._f(time + half, *middle)
            p = [
                arb_poly([x, arb(s).mid()])
                for x, s in zip(region.centre, slopes, strict=True)
            ]
            line = Advance(region, target, p, _tube(region, 3, self._tolerance))
            for _ in range(4):
                try:
                    return prove(
                        self._f,
                        self._jacobian,
                        line,
                        1,
                        self._tolerance,
                        across_kink=True,
                    )
                except Refused as why:
                    if why.wider is None:
                        break
                    line = line._replace(tube=why.wider)
            h *= 0.25
        raise kink
