# SPDX-License-Identifier: Apache-2.0
"""One step of a method, as ordinary functions on numbers of any kind.

On floats they compute a step. On expressions they are traced to the straight-line
program that runs as machine code: what is read here is what runs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from sst_ros.integration.methods import Rosenbrock, Tableau
from sst_ros.mechanism.generic_math import absolute, larger, select, sqrt
from sst_ros.state import LAGGED_TORQUES, QUATERNION, STAR_RATE

Number = Any
Numbers = Sequence[Any]
Derivative = Callable[[Number, Numbers, Any], Numbers]
"""(time [s], state, drive) -> the derivative of the state.

What a drive is, the caller knows.
"""

_RADIANS_PER_STEP = 1e-3
"""Least angle in a step that a rate counts as [rad].

Otherwise rest could not be reached.
"""
_NO_DIVISION_BY_ZERO = 1e-300
"""Added where all may be zero; less than what rounding takes off any other number."""


class NewState(NamedTuple):
    """Where a step ends, and the method's estimate of its error; None without one."""

    state: list[Number]
    error: list[Number] | None

    @classmethod
    def of(cls, numbers: Numbers, size: int) -> NewState:
        """Read a state of `size` numbers, and the error behind it, if any."""
        return cls([*numbers[:size]], [*numbers[size:]] or None)

    def numbers(self) -> list[Number]:
        """Return the state, and the error behind it, if any."""
        return [*self.state, *(self.error or ())]


def explicit_step(
    derivative: Derivative,
    method: Tableau,
    t: Number,
    h: Number,
    y: Numbers,
    drives: Sequence[Any],
) -> NewState:
    """Take one step of an explicit Runge-Kutta method.

    Args:
        derivative: of the state.
        method: its coefficients.
        t: time at which the step begins [s].
        h: its length [s].
        y: state at its begin.
        drives: what acts in each stage.

    """
    slopes: list[Numbers] = []
    # What a zero adds is left out: a program that is traced then has no such operation.
    for node, weights, drive in zip(method.c, method.a, drives, strict=True):
        time = t + node * h if node else t
        point = move(y, h, weights, slopes) if slopes else y
        slopes.append(derivative(time, point, drive))
    return end_step(method, h, y, slopes)


def end_step(
    method: Tableau, h: Number, y: Numbers, slopes: Sequence[Numbers]
) -> NewState:
    """Return where an explicit step ends, of the slopes in all of its stages."""
    state = move(y, h, method.b, slopes)
    return NewState(state, _estimate_error(method, h, slopes))


def move(
    y: Numbers, h: Number, weights: Sequence[float], slopes: Sequence[Numbers]
) -> list[Any]:
    """Return y + h (sum of weights times slopes)."""
    moved = []
    for number, rates in zip(y, zip(*slopes, strict=True), strict=True):
        moved.append(number + h * _weigh(weights, rates))
    return moved


def _weigh(weights: Sequence[float], numbers: Numbers) -> Number:
    """Return the sum of weights times numbers, from the first to the last.

    Weights that are zero cost no operation.
    """
    total = None
    for weight, number in zip(weights, numbers, strict=True):
        if weight:
            term = weight * number
            total = term if total is None else total + term
    return 0.0 if total is None else total


def _estimate_error(
    method: Tableau, h: Number, slopes: Sequence[Numbers]
) -> list[Number] | None:
    """Return the error estimate of each number of the state, None without one."""
    if not method.error:
        return None
    errors = []
    for column in zip(*slopes, strict=True):
        fine = _weigh(method.error, column)
        if method.damping:
            # Hairer's estimate for DOP853, each number of the state for itself.
            coarse = _weigh(method.damping, column)
            square = fine * fine + 0.01 * (coarse * coarse) + _NO_DIVISION_BY_ZERO
            errors.append(h * fine * absolute(fine) / sqrt(square))
        else:
            errors.append(h * fine)
    return errors


class Linearisation(NamedTuple):
    """The derivative at a point, and its derivatives by the time and the state.

    `columns[j][i]` is that of the i-th number by the j-th.
    """

    slope: Numbers
    by_time: Numbers
    columns: Sequence[Numbers]


def rosenbrock_step(
    derivative: Derivative,
    linearisation: Linearisation,
    method: Rosenbrock,
    t: Number,
    h: Number,
    y: Numbers,
    drive: Any,
) -> NewState:
    """Take one step of a Rosenbrock method.

    See Hairer & Wanner, Solving ODEs II, section IV.7. The last stage is what the
    solution adds to the embedded one. The Jacobian may be that of a point near y. See
    `explicit_step` for the arguments.
    """
    columns = linearisation.columns
    # 1 / (gamma h) - J, by rows
    matrix = [[-number for number in row] for row in zip(*columns, strict=True)]
    for i, row in enumerate(matrix):
        row[i] = row[i] + 1.0 / (method.gamma * h)
    decomposition = factorise(matrix)
    stages: list[list[Number]] = []
    for weights, couplings, node, time_weight in zip(
        method.a, method.c, method.alpha, method.d, strict=True
    ):
        point: Numbers = y
        for weight, stage in zip(weights, stages, strict=True):
            point = _add_multiple(point, weight, stage)
        slope = derivative(t + node * h, point, drive)
        right_side = _add_multiple(slope, h * time_weight, linearisation.by_time)
        for coupling, stage in zip(couplings, stages, strict=True):
            right_side = _add_multiple(right_side, coupling / h, stage)
        stages.append(substitute(decomposition, right_side))
    error = stages[-1]
    # The last point is the embedded solution.
    return NewState([a + b for a, b in zip(point, error, strict=True)], error)


def _add_multiple(numbers: Numbers, factor: Number, others: Numbers) -> list[Number]:
    """Return numbers + factor * others."""
    return [a + factor * b for a, b in zip(numbers, others, strict=True)]


def _subtract(numbers: Numbers, others: Numbers) -> list[Number]:
    return [a - b for a, b in zip(numbers, others, strict=True)]


class Decomposition(NamedTuple):
    """L and U of a matrix with exchanged rows, and where rows were exchanged.

    `exchanges[k]` has a number for each row below the k-th: where it is > 0 they
    changed places.
    """

    rows: list[list[Number]]
    exchanges: list[list[Number]]


def factorise(matrix: Sequence[Numbers]) -> Decomposition:
    """Decompose a matrix with partial pivoting.

    There is no branch, so it can be traced: each row below the k-th changes places with
    it where its k-th number is larger. The largest then is in the k-th row. Which rows
    change places is data.
    """
    rows = [list(row) for row in matrix]
    size = len(rows)
    exchanges = []
    for k in range(size):
        larger_below = []
        for i in range(k + 1, size):
            condition = absolute(rows[i][k]) - absolute(rows[k][k])
            larger_below.append(condition)
            for j in range(k, size):
                upper, lower = rows[k][j], rows[i][j]
                rows[k][j] = select(condition, lower, upper)
                rows[i][j] = select(condition, upper, lower)
        exchanges.append(larger_below)
        for i in range(k + 1, size):
            factor = rows[i][k] / (rows[k][k] + _NO_DIVISION_BY_ZERO)
            rows[i][k] = factor
            for j in range(k + 1, size):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
    return Decomposition(rows, exchanges)


def substitute(decomposition: Decomposition, right: Numbers) -> list[Number]:
    """Solve a decomposed system for a right side."""
    rows, exchanges = decomposition
    size = len(rows)
    x = list(right)
    for k in range(size):
        for i, condition in enumerate(exchanges[k], start=k + 1):
            upper, lower = x[k], x[i]
            x[k] = select(condition, lower, upper)
            x[i] = select(condition, upper, lower)
        for i in range(k + 1, size):
            x[i] = x[i] - rows[i][k] * x[k]
    for k in reversed(range(size)):
        for j in range(k + 1, size):
            x[k] = x[k] - rows[k][j] * x[j]
        x[k] = x[k] / (rows[k][k] + _NO_DIVISION_BY_ZERO)
    return x


def normalise(state: Numbers) -> list[Number]:
    """Return a state whose quaternion has length 1."""
    x, y, z, w = state[QUATERNION]
    factor = 1.0 / sqrt(x * x + y * y + z * z + w * w)
    others = state[QUATERNION.stop :]
    return [x * factor, y * factor, z * factor, w * factor, *others]


def size_of_error(
    error: Numbers, old: Numbers, new: Numbers, h: Number, lagged: int
) -> Number:
    """Return the largest error of a step relative to what it is an error of.

    That of the quaternion is absolute. That of the rate is relative to its largest
    component, which counts as 1e-3 rad a step at least, so that rest can be reached.
    That of the torques that lag, if there are `lagged` of them, is relative to the
    largest torque. The work has none.
    """
    largest: Number = 0.0
    for number in error[QUATERNION]:
        largest = larger(largest, absolute(number))
    rate, rate_error = _measure_error(error, old, new, STAR_RATE, least=0.0)
    least_rate = _RADIANS_PER_STEP / absolute(h)
    largest = larger(largest, rate_error / larger(rate, least_rate))
    if lagged:
        torque, torque_error = _measure_error(
            error, old, new, LAGGED_TORQUES, least=_NO_DIVISION_BY_ZERO
        )
        largest = larger(largest, torque_error / torque)
    return largest


def _measure_error(
    error: Numbers, old: Numbers, new: Numbers, indices: slice, least: float
) -> tuple[Number, Number]:
    """Return the size of some numbers of the state, and that of their error.

    The first is the largest magnitude in the state before and after, at least `least`.
    """
    size: Number = least
    size_of_error: Number = 0.0
    for before, after, error_of_one in zip(
        old[indices], new[indices], error[indices], strict=True
    ):
        size = larger(larger(size, absolute(before)), absolute(after))
        size_of_error = larger(size_of_error, absolute(error_of_one))
    return size, size_of_error


class Pair(NamedTuple):
    """Both solutions after a step, and its error.

    `total` is finite where all numbers of the step are.
    """

    y: list[Number]
    z: list[Number]
    size: Number  # of the error of y
    total: Number


def step_pair(
    step: Callable[[int, Number, Number, Numbers, Numbers], NewState],
    t: Number,
    h: Number,
    y: Numbers,
    z: Numbers,
    lagged: int,
) -> Pair:
    """Advance the solution y by a step of h, and a second one, z, by two of h / 2.

    Args:
        step: takes a step: (number, time, length, state, point) -> the new state. The
            step of y has the number 0, those of z have 1 and 2. The Jacobian is taken
            at `point`. That is y for the first step of z, too, so that both solutions
            have the same Jacobian beside a kink of a force.
        t: time at which the step begins [s].
        h: its length [s].
        y: first solution.
        z: second one.
        lagged: numbers of the state that are lagging torques.

    """
    half = 0.5 * h
    first = step(0, t, h, y, y)
    middle, _ = step(1, t, half, z, y)
    second = step(2, t + half, half, middle, middle)
    return compare(h, y, z, first, second, lagged)


def compare(
    h: Number, y: Numbers, z: Numbers, first: NewState, second: NewState, lagged: int
) -> Pair:
    """Return both solutions after a step of h from y and z, and the error of the first.

    See `step_pair` for the arguments.
    """
    new_y, error_y = first
    new_z, error_z = second
    if error_y is None:  # the method has no estimate of its own
        error_y = _subtract(_subtract(new_z, z), _subtract(new_y, y))
    size = size_of_error(error_y, y, new_y, h, lagged)
    total = add_up([*new_y, *error_y, *new_z, *(error_z or ())])
    return Pair(normalise(new_y), normalise(new_z), size, total)


def is_not_finite(x: Number) -> Number:
    """Return 1 where a number is not finite, else 0."""
    return select(sys.float_info.max - absolute(x), 0.0, 1.0)


def add_up(numbers: Numbers) -> Number:
    """Return the sum of numbers, from the first to the last.

    The built-in `sum` has other bits from Python 3.12 on.
    """
    total: Number = 0.0
    for number in numbers:
        total = total + number
    return total
