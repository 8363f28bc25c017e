# SPDX-License-Identifier: Apache-2.0
"""Many robots step by step: torques in, states out, in arrays that stay in place.

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

from sst_ros.errors import check_kinds, check_kinds_late, refuse_unless
from sst_ros.integration.batch_step import (
    Block,
    Columns,
    Endings,
    locate_ends,
    spaced_rows,
    steps_of_ends,
    whole_lanes,
)
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.columns import compile_columns
from sst_ros.programs.expression import trace
from sst_ros.state import QUATERNION, STAR, STAR_RATE, TORQUES

_GAMMA = slice(3)
_GAMMA_DOT = slice(3, 6)
"""Rows of the joints that a session computes."""
_JOINT_ROWS = _GAMMA_DOT.stop
_WORTH_A_THREAD = 512
"""Robots that are worth a thread: their step takes ten times as long as to wake it."""
_LOCATED = -1
"""In place of the steps at the last reset of a robot whose end has been located."""


class BatchState(NamedTuple):
    """State of all robots, a row each, in arrays that the next step changes."""

    gamma: Array  #: actuator angles [rad], shape (N, 3)
    gamma_dot: Array  #: their rates [rad/s], shape (N, 3)
    quaternion: Array  #: orientations (x, y, z, w) of {E} in {B}, shape (N, 4)
    body_rate: Array  #: angular velocities of the star in {E} [rad/s], shape (N, 3)
    #: 0 while a robot runs on, else why not, see `BatchResult`; (N,)
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
        self._batch = batch
        self._h = step / substeps
        self._substeps = substeps
        y, code = batch.initial(gamma, gamma_dot)
        number = len(code)
        self._start = y.copy()
        self._start_code = code.copy()
        self._angles = _spread(gamma, number)
        self._rates = _spread(gamma_dot, number)
        self._torque_limit = batch.columns.torque_limit
        self.fault_time = np.full(number, np.nan)
        self._columns = Columns(
            y=y,
            drives=batch.drives((0.0, 0.0, 0.0), number),
            code=code,
            time=self.fault_time,
            error=np.zeros(number),
        )
        self._steps_done = 0
        # steps done at the last reset, or _LOCATED
        self._begun = np.zeros(number, dtype=np.int64)
        workers = min(len(os.sched_getaffinity(0)), max(1, number // _WORTH_A_THREAD))
        width = whole_lanes(math.ceil(number / workers))
        begins = range(0, number, width)
        joints = spaced_rows(_JOINT_ROWS, width * len(begins))
        self.state = BatchState(
            joints[_GAMMA, :number].T,
            joints[_GAMMA_DOT, :number].T,
            y[QUATERNION].T,
            y[STAR_RATE].T,
            code,
        )
        self._robots: list[_Robots] = []
        for begin in begins:
            column_range = slice(begin, begin + width)
            self._robots.append(_Robots(batch, column_range, joints[:, column_range]))
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None
        self._each(lambda robots: robots.load(self._columns))

    @check_kinds_late
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
        self._take_torques(torque)
        first = self._steps_done * self._substeps

        def advance(robots: _Robots) -> None:
            robots.advance(first, self._substeps, self._h, self._columns)

        self._each(advance)
        ended = np.flatnonzero((self.state.code > 0) & (self._begun >= 0))
        if len(ended):
            self._locate(ended)
        self._steps_done += 1
        return self.state

    def _take_torques(self, torque: Any) -> None:
        """Write torques into the columns, clamped to the limit of the actuators."""
        rows = self._columns.drives[TORQUES]
        is_plain = type(torque) is np.ndarray and torque.dtype == float
        if is_plain and torque.shape == rows.T.shape and np.isfinite(torque).all():
            np.minimum(torque.T, self._torque_limit, out=rows)
            np.maximum(rows, -self._torque_limit, out=rows)
        else:
            drives = self._batch.drives(torque, rows.shape[1])  # or refuses them
            rows[:] = drives[TORQUES]

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
        index = self._read_rows(rows)
        if gamma is not None or gamma_dot is not None:
            angles = self._angles[index] if gamma is None else gamma
            rates = self._rates[index] if gamma_dot is None else gamma_dot
            y, code = self._batch.initial(angles, rates, index)
            self._start[:, index] = y
            self._start_code[index] = code
            self._angles[index] = angles
            self._rates[index] = rates
        code = self._start_code[index]
        self._columns.y[:, index] = self._start[:, index]
        self._columns.error[index] = 0.0
        self.state.code[index] = code
        self.fault_time[index] = np.where(code < 0, 0.0, np.nan)
        self._begun[index] = self._steps_done
        for robots in self._robots:
            robots.replace(index, self._start, self._start_code)
        return self.state

    def _read_rows(self, rows: Any) -> NDArray[np.intp]:
        """Return the indices of robots."""
        number = len(self.state.code)
        index = np.arange(number) if rows is None else np.asarray(rows)
        if index.dtype == bool and index.shape == (number,):
            index = np.flatnonzero(index)
        are_whole = np.issubdtype(index.dtype, np.integer) or index.size == 0
        inside = bool(are_whole and ((index >= 0) & (index < number)).all())
        refuse_unless(
            "batch",
            (
                "rows",
                rows,
                index.ndim == 1 and inside,
                f"must be whole numbers from 0 to {number - 1}, or a mask of shape"
                f" ({number},)",
            ),
        )
        return index.astype(np.intp)

    def result(self) -> Any:
        """Return a copy of all states, with every quantity of a `BatchResult`."""
        columns = self._columns
        endings = Endings(
            torque=columns.drives[TORQUES].T.copy(),
            code=columns.code.copy(),
            fault_time=columns.time.copy(),
            local_error=columns.error.copy(),
        )
        run_time = (self._steps_done - self._begun) * self._substeps * self._h
        runs_on = np.isnan(columns.time)
        last = np.where(runs_on, run_time, columns.time)
        return self._batch.result_of(endings, last, columns.y.copy())

    def _locate(self, rows: NDArray[np.intp]) -> None:
        """Find when robots that ended in this step did so, from their last reset on."""
        ended = self._columns.of_rows(rows)
        steps = steps_of_ends(ended.time, self._h)
        locate_ends(self._batch.advance, self._h, steps, ended)
        reset_time = self._begun[rows] * self._substeps * self._h
        self.state.code[rows] = ended.code
        self.fault_time[rows] = ended.time - reset_time
        self._begun[rows] = _LOCATED

    def _each(self, work: Callable[[_Robots], None]) -> None:
        """Call a function for the robots of each thread."""
        if self._pool is None:
            work(self._robots[0])
            return
        for future in [self._pool.submit(work, robots) for robots in self._robots]:
            future.result()


class _Robots:
    """Robots of one thread: a block and the joints of its columns.

    Args:
        batch: whose robots they are.
        column_range: their columns.
        joints: where their actuator angles and rates go, shape (6, width of the block).

    """

    def __init__(self, batch: Any, column_range: slice, joints: Array) -> None:
        self._column_range = column_range
        self._joints = joints
        self._block = Block(batch.programs, joints.shape[1])
        self._varied = self._block.given[batch.programs.varied]
        self._compute_joints = joints_of(batch)
        # for each of the two arrays of states
        self._update_joints = []
        for buffer in (0, 1):
            inputs = [*self._block.states(buffer)[STAR], *self._varied]
            self._update_joints.append(self._compute_joints.bind(inputs, [*joints]))

    def load(self, columns: Columns) -> None:
        """Take over states."""
        self._block.load(self._column_range, columns)
        self._update_joints[self._block.now]()

    def replace(
        self, rows: NDArray[np.intp], start: Array, code: NDArray[np.int64]
    ) -> None:
        """Begin again in those of the rows that are here, from columns of states."""
        begin = self._column_range.start
        end = self._column_range.stop
        own_rows = rows[(rows >= begin) & (rows < end)]
        if len(own_rows) == 0:
            return
        places = own_rows - begin
        y = np.ascontiguousarray(start[:, own_rows])
        self._block.replace(places, y, code[own_rows])
        varied = np.ascontiguousarray(self._varied[:, places])
        joints = np.empty((_JOINT_ROWS, len(own_rows)))
        self._compute_joints((), [*y[STAR], *varied], [*joints])
        self._joints[:, places] = joints

    def advance(self, first: int, count: int, h: float, columns: Columns) -> None:
        """Advance by some steps under the torques in the columns."""
        torques = columns.drives[TORQUES, self._column_range]
        self._block.given[TORQUES, : torques.shape[1]] = torques
        self._block.run(self._column_range, first, count, h, columns)
        self._block.store(self._column_range, columns)
        self._update_joints[self._block.now]()


def _spread(values: ArrayLike, number: int) -> Array:
    """Return three numbers for each robot, shape (number, 3)."""
    spread = np.empty((number, 3))
    spread[:] = values
    return spread


def joints_of(batch: Any) -> Any:
    """Compile the angles and rates of the actuators, of the state of the star."""
    model = batch.model

    def angles(*inputs: Any) -> Sequence[Any]:
        joints = model.joints(*inputs)
        return (*joints.gamma, *joints.gamma_dot)

    inputs = (*model.ode.state[STAR], *model.names)
    return compile_columns({"angles": trace(angles, inputs)}, 0)["angles"]
