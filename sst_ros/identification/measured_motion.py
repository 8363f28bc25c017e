# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators, or numbers read off a figure.

Torques are samples at the times of the angles, or each is held over an interval, as a controller's
are. Identification by torques takes a `MeasuredMotion`, identification by simulation readings.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from sst_ros.errors import InputError, Problem, refuse_unless
from sst_ros.scene import torque_profile as torques
from sst_ros.scene.scene import Scene
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import Array

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Measured: TypeAlias = "Recording | Trajectory | Mapping[str, Any] | str | Path"

FEWEST = 20  # samples to identify anything: filters and splines have transients at both ends
NEEDED, OPTIONAL = ("t", "gamma", "torque"), ("gamma_dot", "quaternion", "held")
_HELD = (torques.TorqueTable, torques.ConstantTorque)
OBSERVABLES = ("gamma_1", "gamma_2", "gamma_3", "theta", "phi", "psi", "x", "y", "z")
"""Actuator angles and ZYZ angles [rad], position of E in {B} [m]."""


class MeasuredMotion(NamedTuple):
    """Samples of the actuators.

    Attributes:
        t: times [s], rising, shape (n,).
        gamma: angles [rad], shape (n, 3).
        torque: torques at the joints [N m]: at the samples, shape (n, 3), or means over the
            intervals between them where they are held, shape (n - 1, 3).
        gamma_dot: measured rates [rad/s], shape (n, 3); None where there are none.
        quaternion: orientation (x, y, z, w) of {E} in {B} at the first sample, to select the
            assembly mode; None for the admissible one.
        held: whether torques are held over the intervals.

    """

    t: Array
    gamma: Array
    torque: Array
    gamma_dot: Array | None = None
    quaternion: Array | None = None
    held: bool = False


def open_data(data: Measured) -> Recording | Trajectory | Mapping[str, Any]:
    """Read a recording if a path is given; return other data as they are."""
    if not isinstance(data, (str, Path)):
        return data
    from sst_ros.recording.recording import read  # needs rosbags, which other data do not

    return read(data)


def read_motion(data: Measured) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays, see `identify`, or refuse it.

    Held torques act from sample k to the next (n or n - 1 rows).
    """
    data = open_data(data)
    given = dict(data) if isinstance(data, Mapping) else _take_samples(data)
    held = bool(given.pop("held", False))
    arrays: dict[str, Any] = {}
    problems = [Problem(k, None, "must be given") for k in NEEDED if given.get(k) is None]
    for name, value in given.items():
        if name not in NEEDED + OPTIONAL:
            allowed = f"must be one of {', '.join(NEEDED + OPTIONAL)}"
            problems.append(Problem(name, value, allowed))
        elif value is not None:
            try:
                arrays[name] = np.asarray(value, dtype=float)
            except (TypeError, ValueError):
                problems.append(Problem(name, value, "must be numbers"))
    for name, array in arrays.items():
        for bad in np.argwhere(~np.isfinite(array))[:1].tolist():
            problems.append(Problem(f"{name}{bad}", "not finite", "must be finite numbers"))
    if problems:
        raise InputError("identify", problems)
    t, n = arrays["t"], arrays["t"].size
    good = torques.ascend(t)
    refuse_unless("identify", ("t", t, good, "must be rising times [s], shape (n,)"))
    if held and arrays["torque"].shape == (n, 3):
        arrays["torque"] = arrays["torque"][:-1]
    shapes = {"t": (n,), "torque": (n - held, 3), "quaternion": (4,)}
    if n < FEWEST:
        problems.append(Problem("t", n, f"must be {FEWEST} samples or more"))
    for name, array in arrays.items():
        if array.shape != (shape := shapes.get(name, (n, 3))):
            problems.append(Problem(name, array.shape, f"must have the shape {shape}"))
    if problems:
        raise InputError("identify", problems)
    return MeasuredMotion(**arrays, held=held)


def _take_samples(data: Recording | Trajectory) -> dict[str, Any]:
    """Take a simulated motion, or a recorded run while it has torques."""
    law: Any
    if isinstance(data, Trajectory):
        motion, rows = data, np.full(len(data.t), True)
        # With a lag the torques at the joints are behind those of the law, as in a recording.
        law = "sampled" if data.scene.lags else data.law
    elif hasattr(data, "ticks"):
        motion, ticks = data.trajectory, data.ticks
        begins, ends = ticks.start_ns / 1e9, ticks.end_ns / 1e9
        rows = (motion.t >= begins[0] - 1e-12) & (motion.t <= ends[-1] + 1e-12)
        # With a lag the recorded effort is the torque at the joint, behind that of the tick.
        law = "sampled" if data.scene.lags else torques.TorqueTable(begins, ticks.torque)
    else:
        allowed = "must be a recording or its path, a Trajectory, or a mapping of arrays"
        raise InputError("identify", [Problem("data", data, allowed)])
    t, torque = motion.t[rows], motion.torque[rows]
    held = law is None or isinstance(law, _HELD)
    if held:  # without a law to their sample, see `Trajectory`
        torque = torque[1:] if law is None else _average(law, t)
    return {
        "t": t,
        "gamma": np.unwrap(motion.gamma[rows], axis=0),
        "gamma_dot": motion.gamma_dot[rows],
        "torque": torque,
        "quaternion": next(iter(motion.quaternion[rows]), None),
        "held": held,
    }


def _average(law: torques.TorqueProfile, t: Array) -> Array:
    """Means over the intervals of t of a torque that is constant between its breaks, (n - 1, 3)."""
    if len(t) < 2:
        return np.empty((0, 3))
    breaks = law.kinks()
    edges = np.union1d(t, breaks[(breaks > t[0]) & (breaks < t[-1])])
    areas = law.values(0.5 * (edges[1:] + edges[:-1])) * np.diff(edges)[:, None]
    # Sums over one interval each: a difference of long sums would lose digits.
    total = np.add.reduceat(areas, np.searchsorted(edges, t[:-1]), axis=0)
    return np.asarray(total / np.diff(t)[:, None])


Readings: TypeAlias = tuple[Array, Array, Array | None]
"""Times from 0 or later [s], shape (n,); `OBSERVABLES` [rad], [m], shape (n, 9), nan where there is
none; and their standard deviations, None where they are unknown."""


def take_readings(data: Measured, scene: Scene) -> tuple[torques.TorqueProfile, Readings]:
    """Take measured angles from a motion as for `read_motion`, or readings off a figure.

    Those are a mapping with t [s] and any of OBSERVABLES, shape (n,), nan where nothing was read,
    and deviation, their standard deviation. The torques are then those of the scene.
    """
    if isinstance(data, Mapping) and "torque" not in data:
        return _take_figure(data, scene)
    measured = read_motion(data)
    t = measured.t - measured.t[0]
    values = np.pad(measured.gamma, ((0, 0), (0, 6)), constant_values=np.nan)
    if hasattr(data, "ticks"):  # a recording: torques before the lag, which the model has
        begins = np.round(data.ticks.start_ns / 1e9 - measured.t[0], 9)
        return torques.TorqueTable(begins, data.ticks.torque), (t, values, None)
    # A simulated motion as well, while its torques are known.
    if isinstance(data, Trajectory) and data.law and data.scene.lags and scene.lags:
        held = isinstance(data.law, _HELD)
        torque = _average(data.law, data.t) if held else data.law.values(data.t)
        if np.isfinite(torque).all():  # not of the state, and not lost
            limit = data.scene.torque_limit or np.inf
            measured = measured._replace(torque=np.clip(torque, -limit, limit), held=held)
    if measured.held:
        return torques.TorqueTable(t[:-1], measured.torque), (t, values, None)
    spline = CubicSpline(t, measured.torque)
    return torques.PolynomialTorque(spline.c, spline.x), (t, values, None)


def _take_figure(data: Mapping[str, Any], scene: Scene) -> tuple[torques.TorqueProfile, Readings]:
    t = np.atleast_1d(np.asarray(data.get("t", ()), dtype=float))
    good = t.size > 0 and torques.ascend(t) and bool(t[0] >= 0.0)
    refuse_unless("identify", ("t", t, good, "must be ascending times >= 0 [s]"))
    values = np.full((t.size, len(OBSERVABLES)), np.nan)
    known, problems = f"one of {', '.join(OBSERVABLES)}", []
    for name, given in data.items():
        if name in OBSERVABLES:
            row = np.atleast_1d(np.asarray(given, dtype=float))
            if row.shape == t.shape and not np.any(np.isinf(row)):
                values[:, OBSERVABLES.index(name)] = row
            else:
                problems.append(Problem(name, row.shape, f"must have the shape {t.shape}"))
        elif name not in ("t", "deviation"):
            problems.append(Problem(name, given, f"must be t, deviation or {known}"))
    columns = [i for i, name in enumerate(OBSERVABLES) if name in data]
    if not columns:
        problems.append(Problem("data", list(data), f"must have {known}"))
    deviation = data.get("deviation")
    if deviation is not None and not np.all(np.asarray(deviation) > 0.0):
        problems.append(Problem("deviation", deviation, "must be > 0"))
    if scene.torque is None:
        problems.append(Problem("torque", None, "must be in the scene, or be given as samples"))
    if problems or scene.torque is None:
        raise InputError("identify", problems)
    spread = None if deviation is None else np.ones_like(values)
    if spread is not None:
        spread[:, columns] = deviation
    return scene.torque, (t, values, spread)
