# SPDX-License-Identifier: Apache-2.0
"""One step of many scenarios at once, a column each, and the loop over the steps.

1. The step of a method is traced with the distances to the limits at its end and a test
   whether a limit may have been passed: one program from the numbers of a column to its
   new ones. The operations of a column are those of a run of its own in the same order.
2. A block of columns that fits the cache takes its steps one after another. Columns do
   not depend on each other, so neither blocks nor threads change a bit.
3. What is rare is done for the few columns concerned: which limit was passed first, and
   when. A column that has ended keeps its last valid state; the others continue.

Which limit a step passes first is found from the distances to all. Over a step each
distance d is taken as the cubic of its values and rates at both ends (Hermite), whose
error is at most h^4 max|d^(4)| / 384. A step that ends outside is found, and one that
leaves and comes back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.model import GRAZING
from sst_ros.dynamics.traced_dynamics import ParametricModel
from sst_ros.integration.many_runs import stop_if_asked
from sst_ros.integration.methods import Tableau
from sst_ros.integration.steps import explicit_step, is_not_finite, normalise
from sst_ros.mechanism.generic_math import (
    Scalar,
    absolute,
    larger,
    positive,
    select,
    sqrt,
)
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.columns import compile_columns
from sst_ros.programs.expression import trace
from sst_ros.programs.llvm import LANES
from sst_ros.state import QUATERNION, STAR

LANE_BLOCK = 768
"""Columns of a block at most: their numbers fit the second cache of a core, and a step
of all takes some tens of times as long as the interpreter between two steps."""

CACHE_LINE = 8
"""Doubles in a line of the cache."""

NOT_FINITE_CODE = 1000
"""Code of a scenario whose numbers are no longer finite.

Others are 1 + the limit's index.
"""

EARLIEST = 1e-8
"""Least share of a step at which a crossing is reported: its time lies in this step."""

_NO_SHARE = 2.0
"""Share of a step at which a limit is passed that is not passed in it."""

_EVENT_HALVINGS = 52
"""Halvings of a step until the share is known to all digits of a double."""

REFINED_PARTS = 16
"""Parts of a step that is repeated to locate an end.

The error of the cubic falls by 16^4.
"""

Advance = Callable[..., None]
"""(first, count, step, *columns, rows=None): advances states by `count` steps from step
`first`, and changes the arrays of `Columns`. `rows` are the scenarios whose last step
is repeated; None for all.
"""


class Columns(NamedTuple):
    """Arrays of N scenarios, a column each, that a run changes."""

    y: Array  # states, shape (numbers of a state, N)
    drives: Array  # drive and varied numbers, shape (numbers, N)
    code: NDArray[np.int64]  # see `BatchResult.code`; shape (N,), as are the others
    time: Array  # at which a scenario ended [s]
    error: Array  # largest local error estimate

    def of_rows(self, rows: NDArray[np.intp]) -> Columns:
        """Return copies of the columns of some scenarios."""
        return Columns(
            np.ascontiguousarray(self.y[:, rows]),
            np.ascontiguousarray(self.drives[:, rows]),
            self.code[rows],
            self.time[rows],
            self.error[rows],
        )


class Endings(NamedTuple):
    """How N scenarios ended; `BatchResult` says what the numbers mean."""

    torque: Array  # commanded last [N m], shape (N, 3); not used under a profile
    code: NDArray[np.int64]  # shape (N,), as are the others
    fault_time: Array  # [s]
    local_error: Array


class ColumnStep:
    """The programs of a step of many scenarios, compiled.

    Attributes:
        size: how many numbers a state has.
        drive_size: how many a drive has, those that vary included.
        varied: where in a drive those are.
        limits: number of limits.
        traced: the programs, by name.
        advance: takes a step.
        distances: computes the distances to the limits, and their rates.
        crossing: computes when a limit is passed, see `share_of_crossing`.

    """

    def __init__(self, model: ParametricModel, method: Tableau) -> None:
        self._model = model
        self._method = method
        self.size = len(model.ode.state)
        self.drive_size = len(model.ode.drive) + len(model.names)
        self.varied = slice(len(model.ode.drive), self.drive_size)
        self.limits = len(model.limit_distances.outputs) // 2
        state = [f"y{j}" for j in range(self.size)]
        distances = [f"d{j}" for j in range(2 * self.limits)]
        drive = [f"g{j}" for j in range(self.drive_size)]
        shared = ("t", "h")
        inputs = (*shared, *state, *distances, "error", "running", *drive)
        star_inputs = (*shared, *state[STAR], *drive[self.varied])
        ends = (*shared, "before", "rate_before", "after", "rate_after")
        self.traced = {
            "advance": trace(self._advance, inputs),
            "distances": trace(self._distances, star_inputs),
            "crossing": trace(share_of_crossing, ends),
        }
        functions = compile_columns(self.traced, len(shared))
        self.advance = functions["advance"]
        self.distances = functions["distances"]
        self.crossing = functions["crossing"]

    def _advance(self, t: Scalar, h: Scalar, *inputs: Scalar) -> tuple[Scalar, ...]:
        """Return what a step gives.

        That is the new state, the distances to the limits and their rates, the largest
        error of all steps, and a flag. The flag is positive where a limit may have
        been passed, or a number is not finite.
        """
        distances_end = self.size + 2 * self.limits
        old = inputs[: self.size]
        old_distances = inputs[self.size : distances_end]
        error, running, *drive = inputs[distances_end:]

        def derivative(
            time: Scalar, y: Sequence[Scalar], drive: Any
        ) -> tuple[Scalar, ...]:
            return self._model.derivative(time, *y, *drive)

        drives = [drive] * len(self._method.b)
        moved, errors = explicit_step(derivative, self._method, t, h, old, drives)
        new = normalise(moved)
        distances = self._model.distances(*new[STAR], *drive[self.varied])
        largest_error = error
        if errors is not None:
            for quaternion_error in errors[QUATERNION]:
                largest_error = larger(largest_error, absolute(quaternion_error))
        flag = larger(
            may_cross(h, old_distances, distances), is_not_finite(reduce(add, new))
        )
        # A scenario that has ended stays where it is.
        state = [
            select(running, after, before)
            for before, after in zip(old, new, strict=True)
        ]
        error = select(running, largest_error, error)
        return (*state, *distances, error, select(running, flag, 0.0))

    def _distances(self, t: Scalar, h: Scalar, *inputs: Scalar) -> tuple[Scalar, ...]:
        return self._model.distances(*inputs)


def whole_lanes(count: int) -> int:
    """Return the least multiple of LANES that is not below a number of columns."""
    return math.ceil(count / LANES) * LANES


def spaced_rows(count: int, width: int) -> Array:
    """Return rows of zeros, shape (count, width), an odd number of cache lines apart.

    Rows that are a power of two apart have the same few places in the cache.
    """
    lines = math.ceil(width / CACHE_LINE)
    if lines % 2 == 0:
        lines += 1
    return np.zeros((count, lines * CACHE_LINE))[:, :width]


class Block:
    """Columns that are advanced together, in arrays of their own.

    There are two arrays, which take turns: a step goes from one to the other, so a step
    that is not valid can be taken back. Their rows are the numbers of a state, the
    distances to the limits and their rates, and the largest error.

    Attributes:
        running: 1 for a column that goes on, 0 for one that has ended, shape (width,).
        given: drive and varied numbers, shape (numbers, width).
        width: number of columns.

    """

    def __init__(self, step: ColumnStep, width: int) -> None:
        self._step = step
        self.width = width
        self._size = step.size
        self._limits = step.limits
        self._distances = slice(step.size, step.size + 2 * step.limits)  # rows
        self._error = self._distances.stop  # row
        rows = self._error + 1
        self._states = spaced_rows(rows, width), spaced_rows(rows, width)
        self._current = 0  # which of the two has the state
        self.running = np.zeros(width)
        self._flag = np.zeros(width)
        self.given = spaced_rows(step.drive_size, width)
        first, second = self._states
        fixed = [self.running, *self.given]
        self._advance = (
            step.advance.bind([*first, *fixed], [*second, self._flag]),
            step.advance.bind([*second, *fixed], [*first, self._flag]),
        )
        self._measure = step.distances.bind(
            [*first[STAR], *self.given[step.varied]],
            [*first[self._distances]],
        )

    @property
    def now(self) -> int:
        """Which of the two arrays has the states now."""
        return self._current

    def states(self, buffer: int) -> Array:
        """States in one of the two arrays, shape (size, width)."""
        return self._states[buffer][: self._size]

    def load(self, columns_of_block: slice, columns: Columns) -> None:
        """Take over some columns.

        If there are fewer than the block has, the last one is repeated, and does not
        run.
        """
        self._current = 0
        first = self._states[0]
        fill(first[: self._size], columns.y[:, columns_of_block])
        fill(first[self._error :], columns.error[None, columns_of_block])
        fill(self.given, columns.drives[: len(self.given), columns_of_block])
        code = columns.code[columns_of_block]
        self.running[: len(code)] = code == 0
        self.running[len(code) :] = 0.0
        if self._limits:
            self._measure(0.0, 0.0)

    def replace(
        self, places: NDArray[np.intp], y: Array, code: NDArray[np.int64]
    ) -> None:
        """Begin again in some columns.

        Args:
            places: which.
            y: their states, contiguous rows, shape (size, len(places)).
            code: 0 for one that can run, shape (len(places),).

        """
        current_rows = self._states[self._current]
        current_rows[: self._size, places] = y
        current_rows[self._error, places] = 0.0
        self.running[places] = code == 0
        varied = np.ascontiguousarray(self.given[self._step.varied][:, places])
        distances = np.empty((2 * self._limits, len(places)))
        if self._limits:
            self._step.distances((0.0, 0.0), [*y[STAR], *varied], [*distances])
        current_rows[self._distances, places] = distances

    def store(self, columns_of_block: slice, columns: Columns) -> None:
        """Put states and errors back."""
        number = len(columns.code[columns_of_block])
        current_rows = self._states[self._current]
        columns.y[:, columns_of_block] = current_rows[: self._size, :number]
        columns.error[columns_of_block] = current_rows[self._error, :number]

    def run(
        self,
        columns_of_block: slice,
        first: int,
        count: int,
        h: float,
        columns: Columns,
    ) -> None:
        """Advance the columns that were taken over by `count` steps.

        Step `number` begins at `number` times h [s]. Codes and times of columns that
        end change: to 1 + the index of a limit, or NOT_FINITE_CODE, and to when that
        was [s].
        """
        code = columns.code[columns_of_block]
        time = columns.time[columns_of_block]
        for number in range(first, first + count):
            stop_if_asked()
            self.prepare_step(number)
            self._advance[self._current](number * h, h)
            self._current = 1 - self._current
            if np.count_nonzero(self._flag):
                self._end_columns(number, h, code, time)
                if not self.running.any():
                    return

    def prepare_step(self, number: int) -> None:
        """Do what a subclass has to do before a step."""

    def _end_columns(
        self, number: int, h: float, code: NDArray[np.int64], time: Array
    ) -> None:
        """End columns that passed a limit in a step, or are not finite after it."""
        before = self._states[1 - self._current]
        after = self._states[self._current]
        columns = np.flatnonzero(self._flag > 0.0)
        end_codes, share = self._first_crossings(before, after, h, columns)
        with np.errstate(all="ignore"):
            total = reduce(add, after[: self._size, columns])
            end_codes[~np.isfinite(total)] = NOT_FINITE_CODE
        ends = end_codes > 0
        ended = columns[ends]
        code[ended] = end_codes[ends]
        time[ended] = (number + share[ends]) * h
        self.running[ended] = 0.0
        after[:, ended] = before[:, ended]

    def _first_crossings(
        self, before: Array, after: Array, h: float, columns: NDArray[np.intp]
    ) -> tuple[NDArray[np.int64], Array]:
        """Find which limit each column passes first in a step, and when.

        Returns 1 + the index of the limit, 0 where none is passed, and the share of the
        step, 1 where none is.
        """
        count = len(columns)
        limits = self._limits
        limit_codes = np.zeros(count, dtype=np.int64)
        share = np.ones(count)
        # Distances, and rates, of all limits and columns are one row of `crossing`.
        padded = np.resize(columns, whole_lanes(count))
        ends = []
        for states in (before, after):
            distances_and_rates = states[self._distances][:, padded]
            for quantity in np.split(distances_and_rates, 2):
                ends.append(np.ascontiguousarray(quantity).ravel())
        shares = np.full((limits, len(padded)), _NO_SHARE)
        if limits:
            self._step.crossing((0.0, h), ends, [shares.reshape(-1)])
        for limit in np.flatnonzero((shares < _NO_SHARE).any(axis=1)):
            own = shares[limit, :count]
            earlier = (own < _NO_SHARE) & ((limit_codes == 0) | (own < share))
            limit_codes[earlier] = limit + 1
            share[earlier] = np.maximum(own[earlier], EARLIEST)
        return limit_codes, share


def may_cross(h: Scalar, begin: Sequence[Scalar], end: Sequence[Scalar]) -> Scalar:
    """Return a number > 0 if a step of h may pass a limit.

    At the begin and the end are the distances to all limits, then their rates. A
    distance that falls first and rises then may be negative in between if the tangents
    of both ends meet below zero, as they lie below a curve that turns.
    """
    limits = len(begin) // 2
    largest: Scalar = 0.0
    for j in range(limits):
        before = begin[j]
        after = end[j]
        falling = h * begin[limits + j]
        rising = h * end[limits + j]
        # of the sign of the distance at which the tangents meet, where they do
        meeting = before * rising - falling * after + falling * rising
        dips = select(-falling, select(rising, -meeting, -1.0), -1.0)
        largest = larger(larger(largest, dips), -GRAZING - after)
    return largest


def share_of_crossing(
    t: Scalar,
    h: Scalar,
    before: Scalar,
    rate_before: Scalar,
    after: Scalar,
    rate_after: Scalar,
) -> tuple[Scalar]:
    """Return the share of a step of h at which a distance becomes negative.

    It is _NO_SHARE where it does not. The distance is the cubic of its values and rates
    at both ends.
    """
    falling = h * rate_before
    rising = h * rate_after
    # coefficients of the cubic in the share
    square = 3.0 * (after - before) - 2.0 * falling - rising
    cube = falling + rising - 2.0 * (after - before)
    root = sqrt(positive(square * square - 3.0 * cube * falling))

    def value(share: Scalar) -> Scalar:
        return before + share * (falling + share * (square + share * cube))

    # Where it has its least value: at the end, unless it falls first and rises then.
    turn = -falling / (square + root)
    lowest = select(-falling, select(rising, turn, 1.0), 1.0)
    high = select(-GRAZING - after, 1.0, lowest)
    least = select(-after, after, value(high))
    low = 0.0
    for _ in range(_EVENT_HALVINGS):
        middle = 0.5 * (low + high)
        outside = -value(middle)
        low = select(outside, low, middle)
        high = select(outside, middle, high)
    return (select(-GRAZING - least, high, _NO_SHARE),)


def fill(rows: NDArray[Any], values: NDArray[Any]) -> None:
    """Put columns into rows, and repeat the last one where the rows are longer."""
    number = values.shape[1]
    rows[:, :number] = values
    rows[:, number:] = values[:, -1:]


def advance_blocks(
    block: Block,
    begins: Sequence[int],
    first: int,
    count: int,
    h: float,
    *columns: NDArray[Any],
) -> None:
    """Advance the columns of blocks by `count` steps; see `Block.run`.

    Args:
        block: takes over the columns of each block in turn.
        begins: the first column of each.
        first: number of the first step.
        count: number of steps.
        h: length of a step [s].
        columns: arrays of `Columns`.

    """
    record = Columns(*columns)
    for begin in begins:
        columns_of_block = slice(begin, begin + block.width)
        block.load(columns_of_block, record)
        block.run(columns_of_block, first, count, h, record)
        block.store(columns_of_block, record)


def steps_of_ends(times: Array, step: float) -> Array:
    """Return the numbers of the steps in which scenarios ended at times [s].

    Ends lie behind the begin of a step by EARLIEST of it at least; a tenth of that is
    left for rounding.
    """
    return np.asarray(np.ceil(times / step - 0.1 * EARLIEST) - 1.0)


def locate_ends(advance: Advance, step: float, steps: Array, columns: Columns) -> None:
    """Repeat the steps in which limits were passed by finer ones.

    Codes and times change.

    Args:
        advance: takes steps.
        step: length of a step [s].
        steps: number of the step that a scenario ended in.
        columns: of the scenarios, in their last valid states.

    """
    code = columns.code
    ended = np.flatnonzero((code > 0) & (code < NOT_FINITE_CODE))
    for number in np.unique(steps[ended]):
        rows = ended[steps[ended] == number]
        refined = columns.of_rows(rows)
        refined.code[:] = 0
        refined.time[:] = np.nan
        refined.error[:] = 0.0
        first = int(number) * REFINED_PARTS
        advance(first, REFINED_PARTS, step / REFINED_PARTS, *refined, rows=rows)
        located = (refined.code > 0) & (refined.code < NOT_FINITE_CODE)
        code[rows[located]] = refined.code[located]
        columns.time[rows[located]] = refined.time[located]
