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
from operator import methodcaller
from typing import Any, NamedTuple, NoReturn

import numpy as np

from sst_ros.mechanism.generic_math import rows_of
from sst_ros.programs.expression import MATH_FUNCTIONS, Program, execute
from sst_ros.proof.balls import (
    arb,
    arb_mat,
    arb_poly,
    arb_series,
    around_zero,
    between,
    column,
    entries,
    from_columns,
    identity,
    magnitude,
    middles,
    radii,
    zeros,
)

Function = Callable[..., Sequence[Any]]

# Orders of expansions: higher ones are tighter and take longer.
J_ORDER = 8  # of the Jacobian
V_ORDER = 16  # of V
KINK_V_ORDER = 4  # of V in a step across a kink
JACOBIAN_TERMS = 4  # coefficients of the Jacobian that p is found by

# Sets.
SKEW = 1e4  # condition of the axes of a set beyond which they are made orthogonal
REMAINDER_GROWTH = 0.05  # of a set by the remainder of V, largest in a step
LOSS = 1e-4  # of a set in a step, relative to it: shorter steps are tried beyond it
UNSEEN = 0.01  # share of the tolerance below which a step may widen the set
MUCH_LESS = 0.2  # loss of a shorter step that is worth it, relative to the longer one's
# Weights of a norm are found by power iteration: its steps, what of the last weights is
# kept in each so that it converges, and the least weight by the largest.
WEIGHT_STEPS = 20
KEPT_WEIGHT = 1e-3
LEAST_WEIGHT = 1e-9

# Tubes, wider than what they are around.
ROOM = 3  # around a region, times it
MOST_ROOM = 100  # the same where steps need more
TIGHT = 1.1  # around what a step was proven to reach, times that
TUBE_TRIES = 4  # wider tubes for a step before it is made shorter
# times the tolerance: a wider tube is not tried for an error that grows more in a step
SLOW_GROWTH = 10.0

# Lengths of steps: they decide how long a proof takes, not what is true.
FIRST_FACTOR = 0.4  # first step by the longest that its series allows, see `_plan`
GROWTH = 4.0  # longest next step by the usual one
REGAIN = 1.25  # longest next step by the last one, after a step was refused
SHORTER = 0.6  # next try by the last one, where a set grows too much
DEFECT_MARGIN = 0.9  # next try by what should just do, where the defect is too large
LEAST_SHORTER = 0.2  # next try by the last one, at least
DEFECT_AIM = 0.5  # defect that the next step is to have, relative to the tolerance
# Change of this factor from a step to the next.
LEAST_CHANGE = 0.7
MOST_CHANGE = 1.3
LEAST_USUAL = 0.1  # by which a single short step makes the usual one shorter, at most
END_MARGIN = 1.01  # a step that is shorter than the time left by less takes all of it
LEAST_STEP = 1e-9  # of a step, relative to the whole time: the proof ends
KINK_STEP = 1e-11  # first step across a kink, relative to the whole time
KINK_STEPS = 400  # steps across one kink before the proof ends
KINK_LOSS = 0.02  # of a set in a step across a kink: below it the next is longer
KINK_HALVINGS = 30  # of the time in which a kink is looked for

CUT = "an angle may pass pi, where that of the model jumps"
UNBOUNDED = "a number is not bounded: a singularity may be near"


class Refused(ArithmeticError):
    """A step is not proven.

    Attributes:
        shorter: length of the next try, as a share of that of the step.
        wider: tube in which the step may be proven as it is; None where that is in
            vain.

    """

    def __init__(
        self, reason: str, shorter: float = 0.5, wider: list[Any] | None = None
    ) -> None:
        super().__init__(reason)
        self.shorter = shorter
        self.wider = wider


class KinkMet(Refused):
    """A function has a kink, or may have one, in what is looked at."""


def _to_floats(matrix: Any) -> np.ndarray[Any, Any]:
    """Return the middles of the entries of a matrix as doubles."""
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
    y = arb_series(y)
    x = arb_series(x)
    slope = (y.derivative() * x - x.derivative() * y) / (x * x + y * y)
    return slope.integral() + angle


class _Kink:
    """What may be on both sides of a kink.

    Nothing is known of it, but that zero times it is zero. So is the damping of an
    elastic stop that is not touched.
    """

    def __mul__(self, other: Any) -> Any:
        numbers = other.coeffs() if isinstance(other, arb_series) else [other]
        for number in numbers:
            # A ball around zero is neither == 0 nor != 0.
            is_zero = not isinstance(number, _Kink) and number == 0
            if not is_zero:
                return self
        return arb(0)

    __rmul__ = __mul__

    def refuse(self, *_: object) -> NoReturn:
        raise KinkMet("a kink: a contact begins or ends, or a torque meets its limit")

    __add__ = __radd__ = __sub__ = __rsub__ = __neg__ = refuse
    __truediv__ = __rtruediv__ = __arb__ = refuse


class _KinkWatch:
    """What decides on which side of a kink a number is in a span of time.

    Its value anywhere in the span is that in the middle and its derivative times the
    time from there (the mean value theorem), which is narrower than its value in
    interval arithmetic. So a program is run at the middle first, and the values are
    noted in the order in which it computes them; then it is run in all of the span, and
    reads them in this order.
    """

    def __init__(self) -> None:
        self._noted: list[Any] = []
        # largest time from the middle; None where the values are noted
        self._reach: Any = None
        self._next = 0  # of the noted values

    @contextlib.contextmanager
    def within(self, reach: Any = None) -> Iterator[None]:
        """Note the values in the middle of a span; read them where there is a reach."""
        global _watch
        before, _watch = _watch, self
        self._reach = reach
        self._next = 0
        if reach is None:
            self._noted.clear()
        try:
            yield
        finally:
            _watch = before

    def narrow(self, x: Any) -> Any:
        """Return the value of a number, narrower where its middle is known."""
        value = _first(x)
        if self._reach is None:
            self._noted.append(value)
            return value
        middle = value
        if self._next < len(self._noted):
            middle = self._noted[self._next]
        self._next += 1
        if isinstance(value, _Kink) or isinstance(middle, _Kink):
            return value
        if not isinstance(x, arb_series) or x.prec < 2:
            return value
        slope = x[1]
        if isinstance(slope, _Kink):
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
    """Return max(x, 0): of a number on both sides of zero, all that may be."""
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
    once, always, results = program.split(range(count))
    names = _ON_BALLS | dict(zip(program.inputs[count:], constants, strict=True))
    execute(_name_steps("\n".join(once)), names)
    head = f"def function({', '.join(program.inputs[:count])}):"
    last = f"return ({', '.join(results)},)"
    execute(_name_steps("\n    ".join([head, *always, last])), names)
    function: Function = names["function"]
    return function


def _name_steps(source: str) -> str:
    """Call `step` in the source of a program where it compares a number with zero."""
    return re.sub(r"\(1\.0 if (.+) > 0\.0 else 0\.0\)", r"step(\1)", source)


def _series(polynomial: Any, size: int) -> Any:
    return arb_series(polynomial.coeffs()[:size], size)


def _coefficients(x: Any, size: int) -> list[Any]:
    """Return the coefficients of a series below `size`, which are known."""
    if isinstance(x, _Kink):
        x.refuse()
    if not isinstance(x, arb_series):
        return [arb(x), *[arb(0)] * (size - 1)]
    if x.prec < size:
        reason = "a series is shorter than asked: another thread uses python-flint"
        raise Refused(reason)
    coefficients = x.coeffs()
    return [*coefficients, *[arb(0)] * size][:size]


# Sets, and what a step proves.


class Region(NamedTuple):
    """Where the solution is at a time: centre + C a + B b.

    The numbers a and b here are columns of bounds of all |a_i| and |b_i|.
    """

    time: float
    centre: list[Any]  # exact
    c: Any  # exact, as all that follow
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
        axes = identity(n)
        widths = column(radii(balls))
        return cls(time, middles(balls), axes, widths, axes, b=column([0] * n))

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
        exact_c = c.mid()
        widths = column([arb(x).upper() for x in a])
        error_bounds = column(radii(centre)) + column(
            [arb(x).abs_upper() for x in errors]
        )
        b = magnitude(magnitude(c - exact_c) * widths + error_bounds)
        axes = identity(len(centre))
        return cls(time, middles(centre), exact_c, widths, axes, b, fixed)

    def spread(self, by: Any = 1) -> Any:
        """Bound each number of by e."""
        return magnitude(by * self.c) * self.a + magnitude(by * self.axes) * self.b


class Advance(NamedTuple):
    """A step from begin to end: the solution is p(s) + V(s) e(0) + w."""

    begin: Region
    end: float
    p: list[Any]  # polynomials
    tube: list[Any]  # balls of e in the whole step, once proven those that it reaches
    defect: float = 0.0  # largest integral of |d_i|, not rounded outward
    v: Sequence[Any] = ()  # coefficients of V
    w: Any = None  # a column of bounds of all |w_i|
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
        bounds = magnitude(self.begin.spread(by * self.flow(s)) + w)
        return [p(s) for p in self.p], entries(bounds)

    def expand(
        self, function: Function, where: Any, size: int, tube: Sequence[Any]
    ) -> list[Any]:
        """Return coefficients below `size` of a function at s = where.

        It is a function of t and y = p + e, with e in `tube`.
        """
        from_there = arb_poly([where, 1])
        state: list[Any] = []
        for i, (p, e) in enumerate(zip(self.p, tube, strict=True)):
            if i < self.begin.moving:
                state.append(_series(p(from_there) + e, size))
            else:
                state.append(self.begin.centre[i] + e)
        time = arb_series([arb(self.begin.time) + where, 1], size)
        return [_coefficients(x, size) for x in function(time, *state)]

    def values(self, function: Function, where: Any, tube: Sequence[Any]) -> list[Any]:
        """Enclose the values of a function at s in `where`.

        It is a function of t and y = p + e, with e in `tube`.
        """
        state = (p(where) + e for p, e in zip(self.p, tube, strict=True))
        return list(map(arb, function(arb(self.begin.time) + where, *state)))

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
        part_length = (end - begin) / span_count
        watch = _KinkWatch()
        reach = ((end - begin) / 2).abs_upper()
        with watch.within():
            about_middle = self.expand(function, (begin + end) / 2, order, tube)
        in_parts = []
        for k in range(span_count):
            part = between(begin + k * part_length, begin + (k + 1) * part_length)
            with watch.within(reach):
                in_parts.append(self.expand(function, part, order + 1, tube))
        enclosed = []
        for i, coefficients in enumerate(about_middle):
            last = reduce(arb.union, (rows[i][order] for rows in in_parts))
            enclosed.append([*coefficients, last])
        return enclosed


def shift(coefficients: Sequence[Any], by: Any) -> list[Any]:
    """Return the coefficients of a polynomial about another point."""
    shifted = []
    for k, coefficient in enumerate(coefficients):
        total = coefficient
        for j in range(k + 1, len(coefficients)):
            total = total + coefficients[j] * (math.comb(j, k) * by ** (j - k))
        shifted.append(total)
    return shifted


def approximate(
    f: Function, jacobian: Function, region: Region, order: int
) -> list[list[Any]]:
    """Return the coefficients of p.

    The series of f(t, p) gives the next coefficient, and nearly those after it: what
    new coefficients add to the series is linear in them, by the Jacobian on the part of
    p that was known.
    """
    n = len(region.centre)
    p = [[x] for x in region.centre]
    j: list[Any] = []  # coefficients of the Jacobian

    def run(function: Function, size: int) -> list[list[Any]]:
        time = arb_series([region.time, 1], size)
        series = (arb_series(row, size) for row in p[: region.moving])
        expansions = function(time, *series, *region.centre[region.moving :])
        return [_coefficients(x, size) for x in expansions]

    known_count = 1
    while known_count <= order:
        if known_count == JACOBIAN_TERMS:
            j = _matrices(run(jacobian, JACOBIAN_TERMS)[n:], n)
        slopes = run(f, min(known_count + len(j), order))
        new_columns: list[Any] = []
        for k in range(known_count - 1, len(slopes[0])):
            slope = column([row[k] for row in slopes])
            for i, new_column in enumerate(new_columns, known_count):
                slope = slope + j[k - i] * new_column
            new_columns.append((slope / (k + 1)).mid())
        for new_column in new_columns:
            for row, coefficient in zip(p, entries(new_column), strict=True):
                row.append(coefficient)
        known_count += len(new_columns)
    return p


def _matrices(flat: Sequence[Sequence[Any]], n: int) -> list[Any]:
    """Return the coefficients of a Jacobian.

    Those of its entries are given column by column.
    """
    matrices = []
    for numbers in zip(*flat, strict=True):
        matrices.append(from_columns(rows_of(numbers, n)))
    return matrices


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
        bounds = [(x - slopes[k]).abs_upper() for k, x in enumerate(row)]
        # max() of Python would skip a nan later
        if not all(bound.is_finite() for bound in bounds):
            raise Refused(UNBOUNDED)
        d.append(bounds)
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
    moving = step.begin.moving
    if across_kink:
        j_order = 0
        v_order = KINK_V_ORDER
        defect_order = 0
        largest_defect = math.inf
    else:
        j_order = J_ORDER
        v_order = V_ORDER
        defect_order = order
        largest_defect = tolerance
    d = bound_defect(f, step, defect_order)
    step = _measure_defect(step, d, order, largest_defect)
    j = _matrices(step.enclose(jacobian, j_order, step.tube)[n:], n)
    step = step._replace(v=_fundamental(j, step.half, v_order))
    jacobian_in_step = _values_of(j, step.half)
    weights = _weights(jacobian_in_step)
    source = entries(step.begin.spread(_remainder(j, step)))  # of (J V - V') e(0)
    integrals = [x * step.length for x in source]
    for k in range(defect_order + 1):
        for i, row in enumerate(d):
            integrals[i] += 2 * row[k] * step.half ** (k + 1) / (k + 1)
    by_norm = _bound_by_norm(jacobian_in_step, weights, source, d[:moving], step)
    by_number = _bound_by_number(jacobian_in_step, integrals[:moving], step.length)
    w = [x.min(y).upper() for x, y in zip(by_norm, by_number, strict=True)]
    w += [arb(0)] * step.begin.fixed
    return _check_tube(step._replace(w=column(w), weights=weights), tolerance)


def _bound_by_norm(
    jacobian: Any,
    weights: Sequence[Any],
    source: Sequence[Any],
    d: Sequence[Sequence[Any]],
    step: Advance,
) -> list[Any]:
    """Bound w by the logarithmic norm of J, that of what moves."""
    moving = range(len(d))
    size = magnitude(jacobian)
    growth = arb(0)  # of J
    largest = arb(0)  # norm of (J V - V') e(0)
    for i in moving:
        off_diagonal = arb(0)
        for k in moving:
            if k != i:
                off_diagonal += size[i, k] * weights[k]
        growth = growth.max((jacobian[i, i] + off_diagonal / weights[i]).upper())
        largest = largest.max((source[i] / weights[i]).upper())
    # The integral of the norm of both is not less than the norm of the integral.
    most = largest * step.length
    for k in range(len(d[0])):
        sizes = [(d[i][k] / weights[i]).upper() for i in moving]
        largest_size = reduce(arb.max, sizes)
        most += 2 * largest_size * step.half ** (k + 1) / (k + 1)
    bound = (growth * step.length).exp() * most
    return [(bound * weights[i]).upper() for i in moving]


def _bound_by_number(jacobian: Any, integrals: Sequence[Any], length: Any) -> list[Any]:
    """Bound w number by number, by integrals of what makes it grow.

    |w_i|' <= J_ii |w_i| + sum |J_ik| |w_k| + |g_i|, whose right side grows with all
    w_k, so that |w| <= exp(A h) (integral of |g|) where A bounds |J_ik|, and J_ii from
    0 on.
    """
    moving = range(len(integrals))
    size = magnitude(jacobian)
    rates = [[size[i, k] * length for k in moving] for i in moving]
    for i in moving:
        rates[i][i] = jacobian[i, i].upper().max(arb(0)) * length
    grown = arb_mat(rates).exp() * column([x.upper() for x in integrals])
    bounds = [x.upper() for x in entries(grown)]
    return [x if x.is_finite() else arb("inf") for x in bounds]


def _measure_defect(
    step: Advance, d: Sequence[Sequence[Any]], order: int, tolerance: float
) -> Advance:
    """Note the integral of the last term of the defect.

    Raises Refused where it is too large. The terms below it come from the balls of
    numbers; shorter steps do not make these smaller.
    """
    size = len(d[0])
    last = max(float(row[-1] * step.length**size / size) for row in d)
    step = step._replace(defect=last)
    if not last <= tolerance:
        excess = last / tolerance
        shorter = 0.5
        if excess < math.inf:
            shorter = max(DEFECT_MARGIN * excess ** (-1.0 / order), LEAST_SHORTER)
        raise Refused("the defect is too large", shorter)
    return step


def _fundamental(j: Sequence[Any], half: Any, order: int) -> list[Any]:
    """Return the coefficients of V about the middle.

    V is nearly a fundamental matrix of J.
    """
    about_middle = shift([_to_floats(matrix) for matrix in j], -float(half))
    v = [np.eye(len(about_middle[0]))]
    for k in range(order):
        terms = [about_middle[i] @ v[k - i] for i in range(min(k, len(j) - 1) + 1)]
        v.append(np.sum(terms, axis=0) / (k + 1))
    return [arb_mat(matrix.tolist()) for matrix in v]


def _remainder(j: Sequence[Any], step: Advance) -> Any:
    """Enclose J V - V' in the whole step."""
    u = between(-step.half, step.half)
    n = len(step.p)
    v = shift(step.v, step.half)  # about the middle, as j
    degree = len(v) - 1
    remainder = zeros(n)
    for k in reversed(range(len(j) + degree)):  # coefficients of powers of u
        term = zeros(n)
        for i in range(max(0, k - degree), min(k, len(j) - 1) + 1):
            term = term + j[i] * v[k - i]
        if k < degree:
            term = term - v[k + 1] * (k + 1)
        remainder = remainder * u + term
    return remainder


def _values_of(j: Sequence[Any], half: Any) -> Any:
    """Enclose the values of a polynomial matrix in the whole step."""
    u = between(-half, half)
    return reduce(lambda partial_sum, matrix: partial_sum * u + matrix, reversed(j))


def _check_tube(step: Advance, tolerance: float) -> Advance:
    """Return a step with the tube that is reached.

    Raises Refused where the error may leave its tube.
    """
    moving = step.begin.moving
    s = between(0, step.length)
    reached = entries(step.begin.spread(step.flow(s)) + step.w)
    pairs = list(zip(reached, step.tube, strict=True))[:moving]
    if all(x.is_finite() and x < e.rad() for x, e in pairs):
        return step._replace(tube=around_zero(reached))
    # A wider tube may do, unless the error grows much in the step: by more than the
    # remainder of V makes the set grow. Numbers of ranges do not move, but what they
    # move counts from the first step on: at the end of the step, as V in all of a long
    # step is much wider than it is.
    at_begin = step.begin.spread()
    at_end = step.begin.spread(step.flow(step.length))
    widest = max(_largest(at_begin, moving), _largest(at_end, moving))
    growth = max(map(float, entries(step.w)))
    wider = None
    if growth < SLOW_GROWTH * tolerance + REMAINDER_GROWTH * widest:
        wider = around_zero([2 * x for x in reached[:moving]]) + step.tube[moving:]
    raise Refused("the error may leave the tube: it grows too fast", SHORTER, wider)


def _largest(bounds: Any, count: int) -> float:
    """Return the largest of the first bounds of a column."""
    return max(map(float, entries(bounds)[:count]))


def _weights(jacobian: Any) -> list[Any]:
    """Return weights of a norm in which |J| is small: nearly its Perron vector."""
    size = np.abs(_to_floats(jacobian))
    weights = np.ones(len(jacobian.tolist()))
    if not np.all(np.isfinite(size)):
        raise Refused(UNBOUNDED)
    for _ in range(WEIGHT_STEPS):
        weights = size @ weights + KEPT_WEIGHT * weights
        weights = np.maximum(weights / weights.max(), LEAST_WEIGHT)
    return [arb(x) for x in weights.tolist()]


def region_at_end(step: Advance, *, boxed: bool = False) -> Region:
    """Return where the solution is at the end of a step, in axes that fit it.

    A region that is `boxed` has the axes of its numbers.
    """
    h = step.length
    start = step.begin
    flow = step.flow(h)
    reached = [p(h) for p in step.p]
    moved = flow * start.axes
    c = flow * start.c
    error = magnitude(c - c.mid()) * start.a + step.w + column(radii(reached))
    centre = middles(reached)
    if boxed:
        axes = identity(len(centre))
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
        weighted = zip(entries(spread), step.weights, strict=True)
        sizes = [float(x / weight) for x, weight in weighted]
        return max(sizes[: step.begin.moving])

    old = size(step.begin.spread(step.flow(step.length)))
    return size(step.w) / old if old else 0.0


def fit_axes(moved: Any, b: Any, scale: Sequence[float]) -> Any:
    """Return axes for a set moved b: its own, or orthogonal ones if these are skew."""
    scales = np.array(scale)[:, None]
    guide = _to_floats(moved) / scales
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
    return around_zero([*moving, *spread[region.moving :]])


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
        self._f = f
        self._jacobian = jacobian
        self._region = start
        self._end = end
        self._tolerance = tolerance
        self._order = order
        self._span = end - start.time
        self._room: float = ROOM  # of the next tube
        self._factor = FIRST_FACTOR  # of the next step by its longest
        self._usual = self._span  # length of steps of late
        self._cruise = self._span  # the same before a kink was near
        self._most = math.inf  # largest length of the next step

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

        Raises KinkMet where a kink is so near that no step is KINK_STEP long.
        """
        region = self._region
        tolerance = self._tolerance
        p = approximate(self._f, self._jacobian, region, self._order)
        polynomials = list(map(arb_poly, p))
        longest = self._longest_step(p)
        wanted = self._factor * longest
        h = min(wanted, GROWTH * self._usual, self._most)
        is_free = h == wanted or self._most < math.inf  # no kink has made it short
        tube = _tube(region, self._room, tolerance)
        tries = 0
        while True:
            target = region.time + h
            if region.time + END_MARGIN * h > self._end:
                target = self._end
            step = Advance(region, target, polynomials, tube)
            try:
                proven = self._prove(step)
                step = self._less_lossy(proven)
                break
            except KinkMet as kink:
                self._room = ROOM
                tube = _tube(region, ROOM, tolerance)
                h = self._clear_length(step._replace(tube=tube))
                is_free = False
                if self._is_too_short(h, KINK_STEP):
                    raise kink from None
            except (ArithmeticError, ValueError) as error:
                why = error if isinstance(error, Refused) else Refused(UNBOUNDED)
                if why.wider is not None and tries < TUBE_TRIES:
                    tube = why.wider
                    tries += 1
                    self._room = min(2 * self._room, MOST_ROOM)
                    continue
                h = why.shorter * (target - region.time)
                tries = 0
                self._most = 0.0
                self._room = ROOM
                tube = _tube(region, ROOM, tolerance)
                if self._is_too_short(h, LEAST_STEP):
                    raise why from None
        is_free = is_free and step.end == proven.end
        self._plan(step.end - region.time, longest, step.defect, is_free=is_free)
        return step

    def _longest_step(self, p: Sequence[Sequence[Any]]) -> float:
        """Return the step at which a last term of p is as large as the tolerance."""
        lengths = []
        for k in (self._order - 1, self._order):
            size = max(float(row[k].abs_upper()) for row in p)
            if size:
                lengths.append((self._tolerance / size) ** (1.0 / k))
        return min(lengths, default=self._usual)

    def _is_too_short(self, h: float, least: float) -> bool:
        """Whether a step is below a share of the whole time, or lost in rounding."""
        time = self._region.time
        return h < least * self._span or time + h == time

    def _less_lossy(self, step: Advance) -> Advance:
        """Return a step, or a shorter one if it widens the set by much less.

        In a stiff contact the Jacobian turns within a step, and its series is what
        widens.
        """
        if not self._is_lossy(step):
            return step
        moving = step.begin.moving
        tight = [TIGHT * x for x in step.tube[:moving]] + step.tube[moving:]
        with contextlib.suppress(ArithmeticError, ValueError):
            step = self._prove(step._replace(tube=tight))
        while self._is_lossy(step):
            end = step.begin.time + SHORTER * (step.end - step.begin.time)
            tube = _tube(step.begin, ROOM, self._tolerance)
            try:
                shorter = self._prove(step._replace(end=end, tube=tube))
            except (ArithmeticError, ValueError):
                return step
            if _loss(shorter) > MUCH_LESS * _loss(step):
                return step
            step = shorter
        return step

    def _is_lossy(self, step: Advance) -> bool:
        """Whether a step widens the set by more than its tolerance, and by much."""
        widened = max(map(float, entries(step.w)))
        return widened > UNSEEN * self._tolerance and _loss(step) > LOSS

    def _prove(self, step: Advance, *, across_kink: bool = False) -> Advance:
        order = 1 if across_kink else self._order
        return prove(
            self._f,
            self._jacobian,
            step,
            order,
            self._tolerance,
            across_kink=across_kink,
        )

    def _plan(
        self, taken: float, longest: float, defect: float, *, is_free: bool
    ) -> None:
        """Choose what the length of the next step is made from."""
        if self._region.time + taken >= self._end:
            return
        self._usual = max(taken, LEAST_USUAL * self._usual)
        if self._most < math.inf:
            self._most = REGAIN * taken
        if not is_free:
            return
        self._cruise = self._usual
        change = MOST_CHANGE
        if defect:
            change = (DEFECT_AIM * self._tolerance / defect) ** (1.0 / self._order)
        change = min(max(change, LEAST_CHANGE), MOST_CHANGE)
        self._factor = taken / longest * change

    def _clear_length(self, step: Advance) -> float:
        """Return how long no kink is near, nearly, by halving a step that has one."""
        low = 0.0
        high = step.end - step.begin.time
        for _ in range(KINK_HALVINGS):
            middle = 0.5 * (low + high)
            try:
                step.enclose(self._f, 2, step.tube, (arb(0), arb(middle)))
                low = middle
            except (ArithmeticError, ValueError):  # KinkMet is one
                high = middle
            if low > 0.9 * high:
                break
        return 0.95 * low

    def _cross_kink(self, kink: KinkMet) -> Iterator[Advance]:
        """Yield steps across a kink, until a step of series is proven.

        Each is twice as long as the one before, unless it loses much.
        """
        h = KINK_STEP * self._span
        factor = self._factor
        cruise = self._cruise
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
        self._usual = cruise
        self._cruise = cruise
        self._factor = factor

    def _kink_step(self, longest: float, kink: KinkMet) -> Advance:
        """Prove a step across a kink by a straight line p."""
        time = self._region.time
        h = longest
        for _ in range(KINK_HALVINGS):
            target = min(self._end, time + h)
            if target == time:
                break
            line = self._line(target)
            for _ in range(TUBE_TRIES):
                try:
                    return self._prove(line, across_kink=True)
                except Refused as why:
                    if why.wider is None:
                        break
                    line = line._replace(tube=why.wider)
            h *= 0.25
        raise kink

    def _line(self, target: float) -> Advance:
        """Return a step to a time along the slope in its middle."""
        region = self._region
        time = arb(region.time)
        half = (arb(target) - time) / 2
        slopes = map(arb, self._f(time, *region.centre))
        middle = []
        for x, slope in zip(region.centre, slopes, strict=True):
            middle.append(x + half * slope.mid())
        slopes = map(arb, self._f(time + half, *middle))
        p = []
        for x, slope in zip(region.centre, slopes, strict=True):
            p.append(arb_poly([x, slope.mid()]))
        return Advance(region, target, p, _tube(region, ROOM, self._tolerance))
