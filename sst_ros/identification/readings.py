# SPDX-License-Identifier: Apache-2.0
"""Measured numbers of a motion: angles at times, also those read off a figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import with_jacobian
from sst_ros.dynamics.model import joint_angle
from sst_ros.dynamics.traced_dynamics import QUATERNION, compile_for_arrays
from sst_ros.errors import InputError, Problem
from sst_ros.identification.measured_motion import Measured, measured_motion
from sst_ros.mechanism.generic_math import ZERO, atan2, rotation_rows, sqrt
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque import TorqueTable
from sst_ros.simulation.torque_profile import PolynomialTorque, SineProfile, TorqueProfile

GAMMA = ("gamma_1", "gamma_2", "gamma_3")
OBSERVABLES = (*GAMMA, "theta", "phi", "psi", "x", "y", "z")
"""Actuator angles and ZYZ angles [rad], position of E in {B} [m]."""


@dataclass(frozen=True)
class Readings:
    """Measured numbers.

    Attributes:
        t: times of the readings, ascending from 0 or later [s], shape (n,).
        columns: numbers of what was read, in `OBSERVABLES`, shape (c,).
        values: the readings [rad], [m], shape (n, c); nan where there is none.
        deviation: their standard deviations, shape (n, c); None where they are unknown.
        torque: torques of the motion.

    """

    t: Array
    columns: tuple[int, ...]
    values: Array
    deviation: Array | None
    torque: TorqueProfile

    def residual(self, scene: Scene, states: Array) -> tuple[Array, Array]:
        """Return computed less read numbers in standard deviations, and slopes by the quaternion.

        Returns:
            Residuals of the r readings, shape (r,), and slopes, shape (r, 4), in order of time;
            those of a time follow each other.

        """
        found = observables(scene)(*states[:, :4].T)
        rows = np.stack([np.broadcast_to(row, len(self.t)) for row in found]).reshape(
            5, -1, len(self.t)
        )
        off = rows[0, list(self.columns)].T - self.values
        angle = np.array(self.columns) < 6
        off[:, angle] = np.angle(np.exp(1j * off[:, angle]))
        deviation = np.ones_like(off) if self.deviation is None else self.deviation
        slopes = np.moveaxis(rows[1:, list(self.columns)], 0, -1).swapaxes(0, 1)
        there = np.isfinite(self.values)
        return (off / deviation)[there], (slopes / deviation[:, :, None])[there]

    @property
    def times_of_residuals(self) -> NDArray[np.intp]:
        """Rows of `t` of the residuals, shape (r,)."""
        return np.nonzero(np.isfinite(self.values))[0]


def readings(data: Measured, scene: Scene) -> Readings:
    """Take measured angles from a motion, or readings off a figure.

    Args:
        data: a recording, a trajectory or arrays as for `measured_motion`; or a mapping with t [s]
            and any of gamma_1 to gamma_3, theta, phi, psi [rad], x, y, z (E in {B}) [m], shape
            (n,), nan where nothing was read, and deviation, their standard deviation. The torques
            are then those of the scene.
        scene: the manipulator.

    Raises:
        InputError: the data are not sound, or the scene has no torques.

    """
    if isinstance(data, Mapping) and "torque" not in data:
        return _of_figure(data, scene)
    measured = measured_motion(data, scene)
    t = measured.t - measured.t[0]
    torque: TorqueProfile
    if hasattr(data, "ticks"):  # a recording: torques before the lag, which the model has
        begins = np.round(data.ticks.start_ns / 1e9 - measured.t[0], 9)
        torque = TorqueTable(begins, data.ticks.torque)
    elif measured.held:
        torque = TorqueTable(t[:-1], measured.torque)
    else:
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(t, measured.torque)
        torque = PolynomialTorque(spline.c, spline.x)
    return Readings(t, (0, 1, 2), measured.gamma, None, torque)


def _of_figure(data: Mapping[str, Any], scene: Scene) -> Readings:
    problems = [
        Problem(name, data[name], f"must be t, deviation or one of {', '.join(OBSERVABLES)}")
        for name in data
        if name not in (*OBSERVABLES, "t", "deviation")
    ]
    columns = tuple(i for i, name in enumerate(OBSERVABLES) if name in data)
    t = np.atleast_1d(np.asarray(data.get("t", ()), dtype=float))
    if not (len(t) and np.all(np.isfinite(t)) and t[0] >= 0.0 and np.all(np.diff(t) > 0.0)):
        problems.append(Problem("t", t, "must be ascending times >= 0 [s]"))
    if not columns:
        problems.append(Problem("data", list(data), f"must have one of {', '.join(OBSERVABLES)}"))
    rows = [np.atleast_1d(np.asarray(data[OBSERVABLES[i]], dtype=float)) for i in columns]
    for i, row in zip(columns, rows, strict=True):
        if row.shape != t.shape or np.any(np.isinf(row)):
            problems.append(Problem(OBSERVABLES[i], row.shape, f"must have the shape {t.shape}"))
    deviation = data.get("deviation")
    if deviation is not None and not np.all(np.asarray(deviation) > 0.0):
        problems.append(Problem("deviation", deviation, "must be > 0"))
    if scene.torque is None:
        problems.append(Problem("torque", None, "must be in the scene, or be given as samples"))
    if problems:
        raise InputError("identify", problems)
    assert scene.torque is not None
    values = np.stack(rows, axis=1)
    spread = None if deviation is None else np.broadcast_to(deviation, values.shape)
    return Readings(t, columns, values, spread, SineProfile(scene.torque))


@lru_cache(maxsize=8)
def observables(scene: Scene) -> Callable[..., tuple[Any, ...]]:
    """Return a function of the quaternion: nine `OBSERVABLES`, then their derivatives by it."""
    model, radius = kernel.model_of(scene), scene.star.radius

    def function(*q: Any) -> tuple[Any, ...]:
        rows = rotation_rows((q[0], q[1], q[2], q[3]))
        legs = [(kernel.leg_motion(leg, rows, ZERO), leg) for leg in model.legs]
        first, second, third = rows
        return (
            *(joint_angle(at, 0, leg.across, leg.v) for at, leg in legs),
            atan2(second[2], first[2]),
            atan2(sqrt(first[2] * first[2] + second[2] * second[2]), third[2]),
            atan2(third[1], -third[0]),
            *(radius * row[2] for row in rows),
        )

    return compile_for_arrays(with_jacobian(function, QUATERNION, QUATERNION))
