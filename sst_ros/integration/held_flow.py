# SPDX-License-Identifier: Apache-2.0
"""A motion under held torques, and its derivatives by its start and the torques.

With the motion y' = f(y, u) the sensitivities S = dy/dy(0) and dy/du obey

    S' = (df/dy) S + df/du

(Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, section I.14).
All numbers are one array, and the steps are those of DOP853 with Hairer's error
estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import ODE
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array
from sst_ros.state import Vector3

_TOLERANCE = 1e-12
"""Largest error of a step, relative to numbers above 1."""
_AT_STOPS = 0.1
"""Share of it where stops are elastic.

A step across a jump of derivatives loses its order.
"""
_NO_DIVISION = 1e-300
"""Added where all may be zero; less than what rounding takes off any other number."""
_SAFETY, _LARGEST_GROWTH, _LARGEST_SHRINKAGE = 0.9, 5.0, 0.2
"""Factors by which a step changes."""
_SHORTEST = 1e-16
"""Share of the period below which no step resolves the motion."""


_STAGES = [np.array(weights) for weights in DOP853.a]
_END = np.array(DOP853.b)
_ERRORS = np.array([DOP853.error, DOP853.damping])


class HeldFlow(NamedTuple):
    """Where a motion under held torques goes.

    Attributes:
        times: of the begin and of the ends of steps [s], shape (n,).
        states: at these times, shape (n, m).
        by_start: derivatives of the last state by the first, shape (m, m).
        by_torque: those by the torques, shape (m, 3).

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
        most: evaluations.
        elastic: whether stops are elastic.

    Returns:
        None where the motion does not last, or takes more evaluations.

    """
    size, linearise = len(y), ode.linearised_by_torque
    drive = (*torque, *(0.0 for _ in ode.drive[3:]))
    columns = 1 + size + 3

    def differentiate(t: float, table: Array) -> Array:
        """Return the derivative of a table with the columns y, dy/dy(0) and dy/du."""
        rows = np.array(linearise(t, *table[:, 0].tolist(), *drive))
        rows = rows.reshape(size + 5, size)
        slope = np.empty((size, columns))
        slope[:, 0] = rows[0]
        np.matmul(rows[2 : size + 2].T, table[:, 1:], out=slope[:, 1:])
        slope[:, -3:] += rows[size + 2 :].T
        return slope.ravel()

    start = np.hstack([np.array(y)[:, None], np.eye(size), np.zeros((size, 3))])
    table = start.ravel()
    slopes = np.empty((len(DOP853.c), table.size))
    tolerance = _TOLERANCE * (_AT_STOPS if elastic else 1.0)
    times, states = [0.0], [start[:, 0]]
    t, h, evaluations = 0.0, length, 0
    while t < length:
        h = min(h, length - t)
        evaluations += len(slopes)
        if evaluations > most or h < _SHORTEST * length:
            return None
        point = table
        for stage, (node, weights) in enumerate(zip(DOP853.c, _STAGES, strict=True)):
            if stage:
                point = table + h * (weights @ slopes[:stage])
            slopes[stage] = differentiate(t + node * h, point.reshape(size, -1))
        after = table + h * (_END @ slopes)
        fine, coarse = _ERRORS @ slopes
        scales = np.maximum(1.0, np.maximum(np.abs(table), np.abs(after)))
        error = h * fine * np.abs(fine)
        error = error / np.sqrt(fine * fine + 0.01 * coarse * coarse + _NO_DIVISION)
        size_of_error = float((np.abs(error) / scales).max()) / tolerance
        if not math.isfinite(size_of_error):
            h *= _LARGEST_SHRINKAGE
            continue
        if size_of_error <= 1.0:
            t = length if h == length - t else t + h
            table = after
            times.append(t)
            states.append(table[::columns])
        h *= _change_of_step(size_of_error)
    ends = table.reshape(size, -1)
    by_start, by_torque = ends[:, 1 : size + 1], ends[:, size + 1 :]
    return HeldFlow(np.array(times), np.array(states), by_start, by_torque)


def _change_of_step(error: float) -> float:
    """Return the next step's factor by the last error, relative to the tolerance."""
    if error == 0.0:
        return _LARGEST_GROWTH
    factor: float = _SAFETY * error ** (-1.0 / (DOP853.error_order + 1))
    return min(max(factor, _LARGEST_SHRINKAGE), _LARGEST_GROWTH)
