# SPDX-License-Identifier: Apache-2.0
"""One step of many scenarios at once, a column each, and the loop over the steps.

1. The step of a method is traced with the distances to the limits at its end and a test
   whether a limit may have been passed: one program from the numbers of a column to its
   new ones. The operations of a column are those of a run of its own in the same order.
2. A block of columns that fits the cache takes its steps one after another. Columns do
   not depend on each other, so neither blocks nor threads change a bit.
3. What is rare is done for the few columns concerned: which limit was passed first, and
   when. A column that has ended keeps its last valid state; the others continue.

Which limit a step passes first is found from the distances to all: over a step each is
a cubic in its values and rates at both ends (Hermite). Its error is at most h^4
max|d^(4)| / 384. A step that ends outside is found, and one that leaves and comes back.
"""

from __future__ import annotations

import sys
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
from sst_ros.integration.steps import explicit_step, normalise
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

LANE_BLOCK = 192
"""Columns of a block at most: their numbers fit the cache of a core, and a step of all
takes a hundred times as long as the interpreter between two steps."""

CACHE_LINE = 8
"""Doubles."""

NOT_FINITE_CODE = 1000
"""Code of a scenario whose numbers are no longer finite.

Others are 1 + the limit's index.
"""

EARLIEST = 1e-8
"""Least share of a step at which a crossing is reported.

So its time lies in this step.
"""

_NO_SHARE = 2.0
"""In place of the share of a step at which a limit is passed, where none is."""

_EVENT_HALVINGS = 52
"""Of a step, until the share is known to all digits of a double."""


class Endings(NamedTuple):
    """How N scenarios ended; `BatchResult` says what the numbers mean."""

    torque: Array  # commanded last [N m], shape (N, 3); not used under a profile
    code: NDArray[np.int64]  # shape (N,), as are the others
    fault_time: Array  # [s]
    local_error: Array


class ColumnStep:
    """The programs of a step of many scenarios, compiled.

    Attributes:
        size: numbers of a state.
        given: numbers of drive and varied numbers together.
        limits: number of limits.
        traced: the programs, by name.

    """

    def __init__(self, model: ParametricModel, method: Tableau) -> None:
        self._model = model
        self._method = method
        self.size = len(model.ode.state)
        self.given = len(model.ode.drive) + len(model.names)
        self.varied = slice(len(model.ode.drive), self.given)
        self.limits = len(model.limit_distances.outputs) // 2
        state = [f"y{j}" for j in range(self.size)]
        distances = [f"was{j}" for j in range(2 * self.limits)]
        drive_names = [f"g{j}" for j in range(self.given)]
        shared = ("t", "h")
        inputs = (*shared, *state, *distances, "error", "running", *drive_names)
        ends = (*shared, "before", "rate_before", "after", "rate_after")
        self.traced = {
            "advance": trace(self._advance, inputs),
            "distances": trace(
                self._distances, (*shared, *state[STAR], *drive_names[self.varied])
            ),
            "crossing": trace(share_of_crossing, ends),
        }
        functions = compile_columns(self.traced, len(shared))
        self.advance = functions["advance"]
        self.distances = functions["distances"]
        self.crossing = functions["crossing"]

    def _advance(self, t: Scalar, h: Scalar, *inputs: Scalar) -> tuple[Scalar, ...]:
        """Return state, distances and their rates, and largest error after a step.

        And a flag.

        The flag is positive where a limit may have been passed or a number is not
        finite.
        """
        numbers = iter(inputs)
        old = [next(numbers) for _ in range(self.size)]
        was = [next(numbers) for _ in range(2 * self.limits)]
        error, running, *drive_numbers = numbers

        def derivative(
            time: Scalar, y: Sequence[Scalar], drive: Any
        ) -> tuple[Scalar, ...]:
            return self._model.derivative(time, *y, *drive)

        drives = [drive_numbers] * len(self._method.b)
        moved, errors = explicit_step(derivative, self._method, t, h, old, drives)
        new = normalise(moved)
        far = self._model.distances(*new[STAR], *drive_numbers[self.varied])
        worst = error
        for state_error in (errors or ())[QUATERNION]:
            worst = larger(worst, absolute(state_error))
        flag = larger(may_cross(h, was, far), is_not_finite(reduce(add, new)))
        # A scenario that has ended stays where it is.
        kept = [
            select(running, after, before)
            for before, after in zip(old, new, strict=True)
        ]
        return (*kept, *far, select(running, worst, error), select(running, flag, 0.0))

    def _distances(self, t: Scalar, h: Scalar, *inputs: Scalar) -> tuple[Scalar, ...]:
        return self._model.distances(*inputs)


def spaced_rows(count: int, width: int) -> Array:
    """Return rows of zeros, shape (count, width), an odd number of cache lines apart.

    Rows that are a power of two apart have the same few places in the cache.
    """
    lines = -(-width // CACHE_LINE) | 1
    return np.zeros((count, lines * CACHE_LINE))[:, :width]


class Block:
    """Columns that are advanced together, in arrays of their own.

    There are two arrays of states, which take turns: a step goes from one to the other,
    so a step that is not valid can be taken back.

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
        rows = step.size + 2 * step.limits + 1
        self._states = spaced_rows(rows, width), spaced_rows(rows, width)
        self._current = 0  # which of the two has the state
        self.running, self._flag = np.zeros(width), np.zeros(width)
        self.given = spaced_rows(step.given, width)
        first, second = self._states
        fixed = [self.running, *self.given]
        self._advance = (
            step.advance.bind([*first, *fixed], [*second, self._flag]),
            step.advance.bind([*second, *fixed], [*first, self._flag]),
        )
        self._measure = step.distances.bind(
            [*first[STAR], *self.given[step.varied]],
            [*first[step.size : -1]],
        )

    @property
    def now(self) -> int:
        """Which of the two arrays has the states now."""
        return self._current

    def states(self, buffer: int) -> Array:
        """States in one of the two arrays, shape (size, width)."""
        return self._states[buffer][: self._size]

    def load(self, columns_of_block: slice, *columns: NDArray[Any]) -> None:
        """Take over columns of states, drives, codes, times and errors.

        If there are fewer than the block has, the last one is repeated.
        """
        y, drives, code, _, error = columns
        self._current = 0
        first = self._states[0]
        fill(first[: self._size], y[:, columns_of_block])
        fill(first[-1:], error[None, columns_of_block])
        fill(self.given, drives[: len(self.given), columns_of_block])
        own = code[columns_of_block]
        self.running[: len(own)] = own == 0
        self.running[len(own) :] = 0.0
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
        current_rows[-1, places] = 0.0
        self.running[places] = code == 0
        varied = np.ascontiguousarray(self.given[self._step.varied][:, places])
        distances = np.empty((2 * self._limits, len(places)))
        if self._limits:
            self._step.distances((0.0, 0.0), [*y[STAR], *varied], [*distances])
        current_rows[self._size : -1, places] = distances

    def store(self, columns_of_block: slice, *columns: NDArray[Any]) -> None:
        """Put states and errors back."""
        y, _, code, _, error = columns
        number = len(code[columns_of_block])
        y[:, columns_of_block] = self.states(self._current)[:, :number]
        error[columns_of_block] = self._states[self._current][-1, :number]

    def run(
        self,
        columns_of_block: slice,
        first: int,
        count: int,
        h: float,
        *columns: NDArray[Any],
    ) -> None:
        """Advance the columns that were taken over by `count` steps.

        Step `number` begins at `number` times h [s]. Codes and times of columns that
        end change: to 1 + the index of a limit, or NOT_FINITE_CODE, and to when that
        was [s].
        """
        _, _, code, time, _ = columns
        for number in range(first, first + count):
            stop_if_asked()
            self.prepare_step(number)
            self._advance[self._current](number * h, h)
            self._current = 1 - self._current
            if np.count_nonzero(self._flag):
                self._end_columns(
                    number, h, code[columns_of_block], time[columns_of_block]
                )
                if not self.running.any():
                    return

    def prepare_step(self, number: int) -> None:
        """Do what is to be done before a step: nothing here."""

    def _end_columns(
        self, number: int, h: float, code: NDArray[np.int64], time: Array
    ) -> None:
        """End columns that passed a limit in a step, or are not finite after it."""
        before, after = self._states[1 - self._current], self._states[self._current]
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
        size = self._size
        limit_codes = np.zeros(count, dtype=np.int64)
        share = np.ones(count)
        padded = np.resize(columns, -(-count // LANES) * LANES)
        ends = [
            np.ascontiguousarray(states[rows, padded]).ravel()
            for states in (before[size:, :], after[size:, :])
            for rows in (
                np.arange(limits)[:, None],
                np.arange(limits, 2 * limits)[:, None],
            )
        ]
        shares = np.full((limits, len(padded)), _NO_SHARE)
        if limits:
            self._step.crossing((0.0, h), ends, [shares.reshape(-1)])
        for limit in np.flatnonzero((shares < _NO_SHARE).any(axis=1)):
            own = shares[limit, :count]
            earlier = (own < _NO_SHARE) & ((limit_codes == 0) | (own < share))
            limit_codes[earlier] = limit + 1
            share[earlier] = np.maximum(own[earlier], EARLIEST)
        return limit_codes, share


def may_cross(h: Scalar, was: Sequence[Scalar], far: Sequence[Scalar]) -> Scalar:
    """Return a number > 0 if a step of h may pass a limit.

    `was` and `far` are distances and their rates at both ends. It compares the tangents
    there, which lie below a curve that turns.
    """
    limits = len(was) // 2
    hit: Scalar = 0.0
    for j in range(limits):
        before, falling = was[j], h * was[limits + j]
        after, rising = far[j], h * far[limits + j]
        tangents = before * rising - falling * after + falling * rising
        dips = select(-falling, select(rising, -tangents, -1.0), -1.0)
        hit = larger(larger(hit, dips), -GRAZING - after)
    return hit


def share_of_crossing(
    t: Scalar,
    h: Scalar,
    before: Scalar,
    rate_before: Scalar,
    after: Scalar,
    rate_after: Scalar,
) -> tuple[Scalar]:
    """Return the share of a step of h at which a distance becomes negative.

    It is _NO_SHARE where none does. Given are the distance and its rate at both ends,
    between which it is a cubic.
    """
    falling, rising = h * rate_before, h * rate_after
    square = 3.0 * (after - before) - 2.0 * falling - rising
    cube = falling + rising - 2.0 * (after - before)
    root = sqrt(positive(square * square - 3.0 * cube * falling))

    def value(share: Scalar) -> Scalar:
        return before + share * (falling + share * (square + share * cube))

    lowest = select(-falling, select(rising, -falling / (square + root), 1.0), 1.0)
    high = select(-GRAZING - after, 1.0, lowest)
    least = value(high)
    least = select(-after, after, least)
    end = high
    low = 0.0
    for _ in range(_EVENT_HALVINGS):
        middle = 0.5 * (low + end)
        outside = -value(middle)
        low, end = select(outside, low, middle), select(outside, middle, end)
    return (select(-GRAZING - least, end, _NO_SHARE),)


def is_not_finite(x: Scalar) -> Scalar:
    """Return 1 where a number is not finite, else 0."""
    return select(sys.float_info.max - absolute(x), 0.0, 1.0)


def fill(rows: NDArray[Any], values: NDArray[Any]) -> None:
    """Put values into rows, which may be longer; the last column is repeated."""
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
        block: the blocks are taken over by it in turn.
        begins: the first column of each.
        first: number of the first step.
        count: number of steps.
        h: length of a step [s].
        columns: states, drives, codes, times and errors, a column a scenario.

    """
    for begin in begins:
        columns_of_block = slice(begin, begin + block.width)
        block.load(columns_of_block, *columns)
        block.run(columns_of_block, first, count, h, *columns)
        block.store(columns_of_block, *columns)


REFINED_PARTS = 16
"""Parts of a step that is repeated to locate an end.

The error of a cubic falls 65,536 times.
"""

Advance = Callable[..., None]
"""(first, count, step, *arrays, rows=None): advances states by steps from step `first`,
and changes `arrays`: states, drives, codes, times and errors. `rows` are those whose
last step is repeated; None for all.
"""


def locate_ends(
    advance: Advance,
    step: float,
    steps: Array,
    y: Array,
    drives: Array,
    code: Any,
    time: Array,
) -> None:
    """Repeat the steps in which limits were passed by finer ones.

    `code` and `time` change.
    """
    ended = np.flatnonzero((code > 0) & (code < NOT_FINITE_CODE))
    for number in np.unique(steps[ended]):
        rows = ended[steps[ended] == number]
        refined_codes = np.zeros(len(rows), dtype=np.int64)
        refined_times = np.full(len(rows), np.nan)
        arrays = (
            np.ascontiguousarray(y[:, rows]),
            np.ascontiguousarray(drives[:, rows]),
            refined_codes,
            refined_times,
        )
        first = int(number) * REFINED_PARTS
        advance(
            first,
            REFINED_PARTS,
            step / REFINED_PARTS,
            *arrays,
            np.zeros(len(rows)),
            rows=rows,
        )
        located = (refined_codes > 0) & (refined_codes < NOT_FINITE_CODE)
        code[rows[located]] = refined_codes[located]
        time[rows[located]] = refined_times[located]
