# SPDX-License-Identifier: Apache-2.0
"""A motion under held torques, and its derivatives by its start and the torques.

With the motion y' = f(y, u) the sensitivities S = dy/dy(0) and dy/du obey

    S' = (df/dy) S + df/du

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section I.14).
Each column of S is integrated beside the motion: a step of DOP853 for both, traced
whole, is one program, which runs for all columns at once. One error control, with
Hairer's estimate, holds for the motion and all columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import LEGS, ODE
from sst_ros.integration.method_steps import LARGEST_SHRINKAGE, step_factor
from sst_ros.integration.methods import DOP853
from sst_ros.integration.steps import add_up, explicit_step
from sst_ros.mechanism.generic_math import absolute, larger
from sst_ros.mechanism.geometry import Array
from sst_ros.programs.compiled import RowsFunction, compile_rows
from sst_ros.programs.expression import Routine, trace
from sst_ros.state import TORQUES, Vector3

_TOLERANCE = 1e-12
"""Largest error of a step, relative to numbers above 1."""
_SHARE_AT_STOPS = 0.1
"""Share of the tolerance where stops are elastic.

A step across a jump of derivatives loses its order.
"""
_SHORTEST = 1e-16
"""Share of the period below which no step resolves the motion."""

# Columns of the outputs of a step, see `_compile_step`
_ERROR = -2
_TOTAL = -1


class HeldFlow(NamedTuple):
    """A motion under held torques, and the derivatives of its end.

    Attributes:
        times: at the begin and at the ends of steps [s], shape (n,).
        states: at these times, shape (n, m).
        by_start: derivatives of the last state by the first, shape (m, m).
        by_torque: derivatives of the last state by the torques, shape (m, 3).

    """

    times: Array
    states: Array
    by_start: Array
    by_torque: Array


def follow_held_torque(
    ode: ODE,
    y: Sequence[float],
    torque: Vector3,
    length: float,
    most: int,
    *,
    elastic: bool,
) -> HeldFlow | None:
    """Integrate a motion and its derivatives under torques that are held.

    Args:
        ode: of the motion, without the work; a moment from a topic is zero.
        y: state at the begin, m numbers.
        torque: what acts [N m].
        length: of the period [s].
        most: evaluations that it may take.
        elastic: whether stops are elastic.

    Returns:
        None where no step resolves the motion, or it takes more evaluations.

    """
    size = len(y)
    step = _compile_step(ode)
    # A row has the motion and a column of S: by the start, then by the torques.
    inputs = _StepInputs(ode, size + LEGS, torque)
    inputs.states[:] = y
    inputs.columns[:size] = np.eye(size)
    inputs.torque_rates[size:] = np.eye(LEGS)
    tolerance = _TOLERANCE * _SHARE_AT_STOPS if elastic else _TOLERANCE
    times = [0.0]
    states = [np.array(y, dtype=float)]
    t = 0.0
    h = length
    evaluations = 0
    while t < length:
        h = min(h, length - t)
        evaluations += len(DOP853.c)
        if evaluations > most or h < _SHORTEST * length:
            return None
        inputs.lengths[:] = h
        results = step(inputs.rows)
        if not np.isfinite(results[:, _TOTAL]).all():
            h *= LARGEST_SHRINKAGE
            continue
        error = float(results[:, _ERROR].max()) / tolerance
        if error <= 1.0:
            is_last = h == length - t
            t = length if is_last else t + h
            inputs.states[:] = results[:, :size]
            inputs.columns[:] = results[:, size : 2 * size]
            times.append(t)
            states.append(results[0, :size].copy())
        h *= step_factor(error, DOP853)
    by_start = inputs.columns[:size].T
    by_torque = inputs.columns[size:].T
    return HeldFlow(np.array(times), np.array(states), by_start, by_torque)


def states_inside(ode: ODE, flow: HeldFlow, torque: Vector3, times: Array) -> Array:
    """Return the states of a motion at times inside its period.

    Each is the end of a shorter step from the begin of the step around it.

    Args:
        ode: as for `follow_held_torque`.
        flow: its result.
        torque: what acted [N m].
        times: after the begin of the period [s], shape (n,).

    Returns:
        States, shape (n, m).

    """
    begins = np.searchsorted(flow.times, times, side="right") - 1
    inputs = _StepInputs(ode, len(times), torque)
    inputs.lengths[:] = times - flow.times[begins]
    inputs.states[:] = flow.states[begins]
    return _compile_step(ode)(inputs.rows)[:, : len(ode.state)]


class _StepInputs:
    """Rows of inputs of `_compile_step`, of n steps under held torques.

    All but the torques are zero at first.

    Attributes:
        rows: all inputs, shape (n, inputs), of which the others are views.
        lengths: of the steps [s], shape (n,).
        states: at the begins, shape (n, m).
        columns: of the derivatives, shape (n, m).
        torque_rates: rates at which torques change along the column, shape (n, 3).

    """

    def __init__(self, ode: ODE, count: int, torque: Vector3) -> None:
        size = len(ode.state)
        widths = [1, size, size, len(ode.drive), LEGS]
        self.rows = np.zeros((count, sum(widths)))
        lengths, self.states, self.columns, drives, self.torque_rates = np.split(
            self.rows, np.cumsum(widths[:-1]), axis=1
        )
        self.lengths = lengths[:, 0]
        drives[:, TORQUES] = torque


@lru_cache(maxsize=32)
def _compile_step(ode: ODE) -> RowsFunction:
    """Compile a step of DOP853 for a motion and one column of its derivatives.

    Its inputs are the length of the step, the state, the column, the drive, and the
    rates at which the torques change along the column. Its outputs are the new state
    and column, their largest error, relative to numbers above 1, and a total that is
    finite where all numbers are.
    """
    size = len(ode.state)
    drive_size = len(ode.drive)
    tangent = Routine("tangent", 1 + 2 * size + drive_size + LEGS, 2 * size)

    def differentiate(
        time: Any, point: Sequence[Any], drive_and_rates: Sequence[Any]
    ) -> Sequence[Any]:
        state = point[:size]
        column = point[size:]
        drive = drive_and_rates[:drive_size]
        torque_rates = drive_and_rates[drive_size:]
        return tangent(time, *state, *drive, *column, *torque_rates)

    def take_step(h: Any, *numbers: Any) -> list[Any]:
        before = numbers[: 2 * size]
        drive_and_rates = numbers[2 * size :]
        drives = [drive_and_rates] * len(DOP853.a)
        # held torques: the motion does not depend on the time
        after, errors = explicit_step(differentiate, DOP853, 0.0, h, before, drives)
        assert errors is not None
        largest: Any = 0.0
        for old, new, error in zip(before, after, errors, strict=True):
            scale = larger(larger(1.0, absolute(old)), absolute(new))
            largest = larger(largest, absolute(error) / scale)
        return [*after, largest, add_up([*after, *errors])]

    state = [f"y{i}" for i in range(size)]
    column = [f"s{i}" for i in range(size)]
    drive = [f"d{i}" for i in range(drive_size)]
    torque_rates = [f"r{i}" for i in range(LEGS)]
    program = trace(take_step, ("h", *state, *column, *drive, *torque_rates))
    return compile_rows({"tangent": ode.tangent, "step": program}, "step")
