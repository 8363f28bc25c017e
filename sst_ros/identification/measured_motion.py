# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators, or numbers read off a figure.

Torques are samples at the times of the angles, or each is held over an interval, as a controller's
are. Identification by torques takes a `MeasuredMotion`, identification by simulation `Readings`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem, refuse_unless
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import (
    ConstantTorque,
    PolynomialTorque,
    SineProfile,
    TorqueProfile,
    TorqueTable,
)
from sst_ros.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Measured: TypeAlias = "Recording | Trajectory | Mapping[str, Any] | str | Path"

FEWEST = 20
"""Samples below which nothing is identified: filters and splines have transients at both ends."""

KEYS = ("t", "gamma", "gamma_dot", "torque", "held", "quaternion")

OBSERVABLES = ("gamma_1", "gamma_2", "gamma_3", "theta", "phi", "psi", "x", "y", "z")
"""Actuator angles and ZYZ angles [rad], position of E in {B} [m]."""


class MeasuredMotion(NamedTuple):
    """Samples of the actuators.

    Attributes:
        t: times [s], rising, shape (n,).
        gamma: angles [rad], shape (n, 3).
        gamma_dot: measured rates [rad/s], shape (n, 3); None where there are none.
        torque: torques at the joints [N m]: at the samples, shape (n, 3), or means over the
            intervals between them, shape (n - 1, 3).
        quaternion: orientation (x, y, z, w) of {E} in {B} at the first sample, to select the
            assembly mode; None for the admissible one.
        saturated: whether a torque was at the limit of the actuators, one for each row of `torque`.

    """

    t: Array
    gamma: Array
    gamma_dot: Array | None
    torque: Array
    quaternion: Array | None
    saturated: NDArray[np.bool_]

    @property
    def held(self) -> bool:
        """Whether torques are held over the intervals."""
        return len(self.torque) == len(self.t) - 1


class Readings(NamedTuple):
    """Measured numbers.

    Attributes:
        t: times of the readings, ascending from 0 or later [s], shape (n,).
        columns: numbers of what was read, in `OBSERVABLES`, c of them.
        values: the readings [rad], [m], shape (n, c); nan where there is none.
        deviation: their standard deviations, shape (n, c); None where they are unknown.
        torque: torques of the motion.

    """

    t: Array
    columns: Sequence[int]
    values: Array
    deviation: Array | None
    torque: TorqueProfile


def read_motion(data: Measured, scene: Scene | None = None, delay: float = 0.0) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays, see `identify`, or refuse it.

    Held torques act from sample k to the next (n or n - 1 rows); measured ones come `delay` [s]
    late. The scene is for the limit of its actuators.
    """
    data = open_data(data)
    given = data if isinstance(data, Mapping) else _take_samples(data)
    held = bool(given.get("held", False))
    allowed = f"must be one of {', '.join(KEYS)}"
    problems = [Problem(key, given[key], allowed) for key in given if key not in KEYS]
    arrays: dict[str, Array] = {}
    for key in ("t", "gamma", "torque", "gamma_dot", "quaternion"):
        if given.get(key) is not None:
            arrays |= _read_array(key, given[key], problems)
        elif key in ("t", "gamma", "torque"):
            problems.append(Problem(key, None, "must be given"))
    if problems:
        raise InputError("identify", problems)
    t, n = arrays["t"], arrays["t"].size
    rising = t.ndim == 1 and bool(np.all(np.diff(t) > 0.0))
    refuse_unless("identify", ("t", t, rising, "must be rising times [s], shape (n,)"))
    if n < FEWEST:
        problems.append(Problem("t", n, f"must be {FEWEST} samples or more"))
    for key in [*arrays][1:]:
        shape = (4,) if key == "quaternion" else (n, 3)
        also = (n - 1, 3) if held and key == "torque" else shape
        if arrays[key].shape not in (shape, also):
            problems.append(Problem(key, arrays[key].shape, f"must have the shape {shape}"))
    if problems:
        raise InputError("identify", problems)
    torque = arrays["torque"]
    if held and len(torque) == n:
        torque = torque[:-1]
    if delay:
        torque = _shift(t, torque, held, delay)
    limit = None if scene is None else scene.torque_limit
    saturated = np.abs(torque).max(axis=1) >= (np.inf if limit is None else limit * (1.0 - 1e-9))
    rates, start = arrays.get("gamma_dot"), arrays.get("quaternion")
    return MeasuredMotion(t, arrays["gamma"], rates, torque, start, saturated)


def _read_array(key: str, value: Any, problems: list[Problem]) -> dict[str, Array]:
    """Return finite numbers by their key, or note a problem."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        problems.append(Problem(key, value, "must be numbers"))
        return {}
    for bad in np.argwhere(~np.isfinite(array))[:1].tolist():
        problems.append(Problem(f"{key}{bad}", "not finite", "must be finite numbers"))
    return {key: array}


def open_data(data: Measured) -> Recording | Trajectory | Mapping[str, Any]:
    """Read a recording if a path is given; return other data as they are."""
    if not isinstance(data, (str, Path)):
        return data
    from sst_ros.recording.recording import read  # needs rosbags, which other data do not

    return read(data)


def _take_samples(data: Recording | Trajectory) -> dict[str, Any]:
    """Take a simulated motion, or a recorded run while it has torques."""
    law: Any
    if isinstance(data, Trajectory):
        motion, law, rows = data, data.law, np.full(len(data.t), True)
    elif hasattr(data, "ticks"):
        motion, ticks = data.trajectory, data.ticks
        begins, ends = ticks.start_ns / 1e9, ticks.end_ns / 1e9
        rows = (motion.t >= begins[0] - 1e-12) & (motion.t <= ends[-1] + 1e-12)
        # With a lag the recorded effort is the torque at the joint, behind that of the tick.
        law = "sampled" if data.scene.lags else TorqueTable(begins, ticks.torque)
    else:
        allowed = "must be a recording or its path, a Trajectory, or a mapping of arrays"
        raise InputError("identify", [Problem("data", data, allowed)])
    given = {
        "t": motion.t[rows],
        "gamma": np.unwrap(motion.gamma[rows], axis=0),
        "gamma_dot": motion.gamma_dot[rows],
        "torque": motion.torque[rows],
        "quaternion": next(iter(motion.quaternion[rows]), None),
    }
    if isinstance(law, (TorqueTable, ConstantTorque)):
        given |= {"torque": _average(law, given["t"]), "held": True}
    elif law is None:  # torques are held to their sample, see `Trajectory`
        given |= {"torque": given["torque"][1:], "held": True}
    return given


def _average(law: TorqueProfile, t: Array) -> Array:
    """Means over the intervals of t of a torque that is constant between its breaks, (n - 1, 3)."""
    if len(t) < 2:
        return np.empty((0, 3))
    breaks = law.kinks()
    edges = np.union1d(t, breaks[(breaks > t[0]) & (breaks < t[-1])])
    areas = law.values(0.5 * (edges[1:] + edges[:-1])) * np.diff(edges)[:, None]
    # Sums over one interval each: a difference of long sums would lose digits.
    total = np.add.reduceat(areas, np.searchsorted(edges, t[:-1]), axis=0)
    return np.asarray(total / np.diff(t)[:, None])


def _shift(t: Array, torque: Array, held: bool, delay: float) -> Array:
    """Torques as they acted, `delay` earlier than they were measured; the last ones are held."""
    if held:
        total = np.vstack([np.zeros(3), np.cumsum(torque * np.diff(t)[:, None], axis=0)])
        return np.diff(_shift(t, total, False, delay), axis=0) / np.diff(t)[:, None]
    return np.stack([np.interp(t + delay, t, column) for column in torque.T], axis=1)


def take_readings(data: Measured, scene: Scene) -> Readings:
    """Take measured angles from a motion as for `read_motion`, or readings off a figure.

    Those are a mapping with t [s] and any of OBSERVABLES, shape (n,), nan where nothing was read,
    and deviation, their standard deviation. The torques are then those of the scene.
    """
    if isinstance(data, Mapping) and "torque" not in data:
        return _take_figure(data, scene)
    measured = read_motion(data, scene)
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


def _take_figure(data: Mapping[str, Any], scene: Scene) -> Readings:
    known = f"one of {', '.join(OBSERVABLES)}"
    problems = [
        Problem(name, data[name], f"must be t, deviation or {known}")
        for name in data
        if name not in (*OBSERVABLES, "t", "deviation")
    ]
    t = np.atleast_1d(np.asarray(data.get("t", ()), dtype=float))
    if not (len(t) and np.all(np.isfinite(t)) and t[0] >= 0.0 and np.all(np.diff(t) > 0.0)):
        problems.append(Problem("t", t, "must be ascending times >= 0 [s]"))
    read = {
        i: np.atleast_1d(np.asarray(data[name], dtype=float))
        for i, name in enumerate(OBSERVABLES)
        if name in data
    }
    if not read:
        problems.append(Problem("data", list(data), f"must have {known}"))
    for i, row in read.items():
        if row.shape != t.shape or np.any(np.isinf(row)):
            problems.append(Problem(OBSERVABLES[i], row.shape, f"must have the shape {t.shape}"))
    deviation = data.get("deviation")
    if deviation is not None and not np.all(np.asarray(deviation) > 0.0):
        problems.append(Problem("deviation", deviation, "must be > 0"))
    if scene.torque is None:
        problems.append(Problem("torque", None, "must be in the scene, or be given as samples"))
    if problems or scene.torque is None:
        raise InputError("identify", problems)
    values = np.stack([*read.values()], axis=1)
    spread = None if deviation is None else np.broadcast_to(deviation, values.shape)
    return Readings(t, tuple(read), values, spread, SineProfile(scene.torque))
