# SPDX-License-Identifier: Apache-2.0
"""Many robots step by step: torques go in, states come out, in arrays that stay in place.

The robots are divided into as many blocks as threads take them, and a step of a block
is one call of the compiled program of `batch_step`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.integration.batch_step import EARLIEST, Block, locate_ends
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.columns import compile_columns
from sst_ros.programs.expression import trace
from sst_ros.programs.llvm import LANES

_WORTH_A_THREAD = 512
"""Robots: their step takes ten times as long as to wake a thread."""


class BatchState(NamedTuple):
    """State of all robots, a row each: views of arrays that the next step changes."""

    gamma: Array  #: actuator angles [rad], shape (N, 3)
    gamma_dot: Array  #: their rates [rad/s], shape (N, 3)
    quaternion: Array  #: orientations (x, y, z, w) of {E} in {B}, shape (N, 4)
    body_rate: Array  #: angular velocities of the star in {E} [rad/s], shape (N, 3)
    # : 0 while a robot runs on, else why not, see `BatchResult`; (N,)
    code: NDArray[np.int64]


class BatchSession:
    """Robots of a batch that are driven step by step; made by `Batch.start`.

    A robot that passes a limit, or whose numbers cease to be finite, stays in its last
    valid state until it is reset; the others go on.

    Attributes:
        state: of all robots, see `BatchState`.
        fault_time: when a robot passed a limit, since its last reset [s], nan where it
            runs on, shape (N,).

    """

    def __init__(
        self,
        batch: Any,
        gamma: ArrayLike,
        gamma_dot: ArrayLike,
        step: float,
        substeps: int,
    ) -> None:
        self._batch, self._h, self._substeps = batch, step / substeps, substeps
        self._y, code = batch.initial(gamma, gamma_dot)
        self._start, self._start_code = self._y.copy(), code.copy()
        number = len(code)
        self._angles, self._rates = self._spread(gamma), self._spread(gamma_dot)
        self._given = batch.drives((0.0, 0.0, 0.0), number)
        self.fault_time = np.full(number, np.nan)
        self._error, self._done = np.zeros(number), 0
        # steps that were done at the last reset
        self._begun = np.zeros(number, dtype=np.int64)
        self._joints = np.zeros((6, number))
        self.state = BatchState(
            self._joints[:3].T, self._joints[3:].T, self._y[:4].T, self._y[4:7].T, code
        )
        workers = min(len(os.sched_getaffinity(0)), max(1, number // _WORTH_A_THREAD))
        width = math.ceil(math.ceil(number / workers) / LANES) * LANES
        parts = [slice(begin, begin + width) for begin in range(0, number, width)]
        self._robots = [_Robots(batch, part, width, self._joints) for part in parts]
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None
        self._each(lambda robots: robots.load(*self._columns))

    @check_kinds
    def step(self, torque: ArrayLike) -> BatchState:
        """Advance all robots by a step under constant torques.

        Args:
            torque: of the actuators [N m], shape (N, 3) or (3,); clamped to their
                limit.

        Returns:
            The state, whose arrays are those of the step before.

        Raises:
            InputError: a torque is not finite, or there is not one for each robot.

        """
        self._given[:3] = self._batch.drives(torque, len(self.state.code))[:3]
        first = self._done * self._substeps

        def advance(robots: _Robots) -> None:
            robots.advance(first, self._substeps, self._h, *self._columns)

        self._each(advance)
        ended = np.flatnonzero((self.state.code > 0) & (self._begun >= 0))
        if len(ended):
            self._locate(ended)
        self._done += 1
        return self.state

    @check_kinds
    def reset(
        self,
        rows: Any = None,
        gamma: ArrayLike | None = None,
        gamma_dot: ArrayLike | None = None,
    ) -> BatchState:
        """Let robots begin again.

        Args:
            rows: indices of the robots, or a mask of shape (N,); all by default.
            gamma: new initial angles [rad], shape (len(rows), 3) or (3,); by default
                the last.
            gamma_dot: new initial rates [rad/s], alike.

        Raises:
            InputError: a row is none of this batch, or an initial value is not allowed.

        """
        number = len(self.state.code)
        index = np.arange(number) if rows is None else np.asarray(rows)
        if index.dtype == bool and index.shape == (number,):
            index = np.flatnonzero(index)
        whole = index.ndim == 1 and (
            index.size == 0 or np.issubdtype(index.dtype, np.integer)
        )
        fits = bool(
            whole and (index.size == 0 or (index.min() >= 0 and index.max() < number))
        )
        allowed = (
            f"must be whole numbers from 0 to {number - 1}, or a mask of shape"
            f" ({number},)"
        )
        refuse_unless("batch", ("rows", rows, fits, allowed))
        index = index.astype(np.intp)
        if gamma is not None or gamma_dot is not None:
            angles, rates = self._angles.copy(), self._rates.copy()
            angles[index] = angles[index] if gamma is None else gamma
            rates[index] = rates[index] if gamma_dot is None else gamma_dot
            self._start, self._start_code = self._batch.initial(angles, rates)
            self._angles, self._rates = angles, rates
        self._y[:, index] = self._start[:, index]
        self.state.code[index] = self._start_code[index]
        self.fault_time[index], self._error[index] = np.nan, 0.0
        self.fault_time[index[self._start_code[index] < 0]] = 0.0
        self._begun[index] = self._done
        self._each(lambda robots: robots.load(*self._columns))
        return self.state

    def result(self) -> Any:
        """Return a copy of all robots' states with every quantity of a `BatchResult`."""
        time = (self._done - np.maximum(self._begun, 0)) * self._substeps * self._h
        batch, code, fault = self._batch, self.state.code.copy(), self.fault_time.copy()
        torque = self._given[:3].T.copy()
        last = np.where(np.isnan(fault), time, fault)
        return batch.result_of(
            code, fault, self._error.copy(), last, torque, self._y.copy()
        )

    def _locate(self, rows: NDArray[np.intp]) -> None:
        """Find when robots that ended in this step did so, from their last reset on."""
        time, code = self.fault_time[rows], self.state.code[rows]
        begins = np.ceil(time / self._h - 0.1 * EARLIEST) - 1.0
        y = np.ascontiguousarray(self._y[:, rows])
        given = np.ascontiguousarray(self._given[:, rows])
        locate_ends(self._batch.advance, self._h, begins, y, given, code, time)
        self.state.code[rows] = code
        self.fault_time[rows] = time - self._begun[rows] * self._substeps * self._h
        self._begun[rows] = -1

    @property
    def _columns(self) -> tuple[NDArray[Any], ...]:
        return self._y, self._given, self.state.code, self.fault_time, self._error

    def _spread(self, values: ArrayLike) -> Array:
        spread: Array = np.broadcast_to(
            np.asarray(values, dtype=float), (self._y.shape[1], 3)
        ).copy()
        return spread

    def _each(self, work: Callable[[_Robots], None]) -> None:
        """Do something with all robots, by threads where that is worth it."""
        if self._pool is None:
            work(self._robots[0])
            return
        for done in [self._pool.submit(work, robots) for robots in self._robots]:
            done.result()


class _Robots:
    """Robots of one thread: a block and the joints of its columns."""

    def __init__(self, batch: Any, part: slice, width: int, joints: Array) -> None:
        programs = batch.programs
        self._part, self._block = part, Block(programs, width)
        self._number = len(range(*part.indices(joints.shape[1])))
        self._whole, self._found = joints, np.zeros((6, width))
        measure = joints_of(batch)
        varied = [*self._block.given[programs.varied]]
        self._measure = [
            measure.bind([*self._block.states(which)[:7], *varied], [*self._found])
            for which in (0, 1)
        ]

    def load(self, *columns: NDArray[Any]) -> None:
        """Take over states."""
        self._block.load(self._part, *columns)
        self._tell()

    def advance(self, first: int, count: int, h: float, *columns: NDArray[Any]) -> None:
        """Advance by some steps under the torques in the columns."""
        self._block.given[:3, : self._number] = columns[1][:3, self._part]
        self._block.run(self._part, first, count, h, *columns)
        self._block.store(self._part, *columns)
        self._tell()

    def _tell(self) -> None:
        self._measure[self._block.now]()
        self._whole[:, self._part] = self._found[:, : self._number]


def joints_of(batch: Any) -> Any:
    """Return the program of actuator angles and rates, of the first seven numbers of a state."""
    model = batch.model

    def angles(*inputs: Any) -> Sequence[Any]:
        found = model.joints(*inputs)
        return (*found.gamma, *found.gamma_dot)

    inputs = (*model.ode.state[:7], *model.names)
    return compile_columns({"angles": trace(angles, inputs)}, 0)["angles"]
