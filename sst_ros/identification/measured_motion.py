# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators, or numbers read off a figure.

Torques are samples at the times of the angles, or each is held over an interval, as a controller's
are. Identification by torques takes a `MeasuredMotion`, identification by simulation readings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from sst_ros.errors import Problem, refusal, refuse_errors, refuse_unless
from sst_ros.scene import torque_profile as torques
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Rules, Section, build, entry
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import Array, Quaternion

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Measured: TypeAlias = "Recording | Trajectory | Mapping[str, Any] | str | Path"

FEWEST = 20  # samples to identify anything: filters and splines have transients at both ends
_HELD = (torques.TorqueTable, torques.ConstantTorque)
OBSERVABLES = ("gamma_1", "gamma_2", "gamma_3", "theta", "phi", "psi", "x", "y", "z")
"""Actuator angles and ZYZ angles [rad], position of E in {B} [m]."""


class MeasuredMotion(Section):
    """Samples of the actuators. Held torques act from sample k to the next (n or n - 1 rows)."""

    ORIGIN = "identify"

    t: Array = entry("times, rising", "s")
    gamma: Array = entry("angles", "rad", shape=(3,))
    torque: Array = entry(
        "torques at the joints: at the samples, or means over the intervals between them where "
        "they are held",
        "N m",
        shape=(3,),
    )
    gamma_dot: Array | None = entry("measured rates", "rad/s", shape=(3,))
    quaternion: Quaternion | None = entry(
        "orientation (x, y, z, w) of {E} in {B} at the first sample, to select the assembly mode; "
        "by default the admissible one",
        "1",
    )
    held: bool = entry("whether torques are held over the intervals", default=False)

    def settle(self) -> Iterator[Problem]:
        """Leave out the torque that is held from the last sample on."""
        if self.held and len(self.torque) == len(self.t):
            vars(self).update(torque=self.torque[:-1])
        return super().settle()

    def rules(self) -> Rules:
        """Refuse times that do not rise, few samples, and other numbers of rows."""
        n = len(self.t)
        yield not torques.ascend(self.t), "t", self.t, "must be rising times [s], shape (n,)"
        yield n < FEWEST, "t", n, f"must be {FEWEST} samples or more"
        rows = {"gamma": n, "torque": n - self.held, "gamma_dot": n}
        for name, count in rows.items():
            array = getattr(self, name)
            wrong = array is not None and len(array) != count
            yield wrong, name, np.shape(array), f"must have the shape {count, 3}"


def open_data(data: Measured) -> Recording | Trajectory | Mapping[str, Any]:
    """Read a recording if a path is given; return other data as they are."""
    if not isinstance(data, (str, Path)):
        return data
    from sst_ros.recording.recording import read  # needs rosbags, which other data do not

    return read(data)


def read_motion(data: Measured) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays, see `identify`, or refuse it."""
    data = open_data(data)
    given = data if isinstance(data, Mapping) else _take_samples(data)
    known = {name: value for name, value in given.items() if value is not None}
    return build(MeasuredMotion, known, "identify")


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
        raise refusal("identify", "data", data, allowed)
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
            measured = replace(measured, torque=np.clip(torque, -limit, limit), held=held)
    if measured.held:
        return torques.TorqueTable(t[:-1], measured.torque), (t, values, None)
    spline = CubicSpline(t, measured.torque)
    return torques.PolynomialTorque(spline.c, spline.x), (t, values, None)


def _take_figure(data: Mapping[str, Any], scene: Scene) -> tuple[torques.TorqueProfile, Readings]:
    t = np.atleast_1d(np.asarray(data.get("t", ()), dtype=float))
    good = t.size > 0 and torques.ascend(t) and bool(t[0] >= 0.0)
    refuse_unless("identify", ("t", t, good, "must be ascending times >= 0 [s]"))
    known, deviation = f"one of {', '.join(OBSERVABLES)}", data.get("deviation")
    with refuse_errors("identify", "data", list(data), "must be numbers", TypeError, ValueError):
        read = {name: np.atleast_1d(np.asarray(x, dtype=float)) for name, x in data.items()}
    rows = {name: row for name, row in read.items() if name in OBSERVABLES}
    positive = deviation is None or bool((read["deviation"] > 0.0).all())
    named, shape = f"must be t, deviation or {known}", f"must have the shape {t.shape}"
    refuse_unless(
        "identify",
        *((x, data[x], x in (*OBSERVABLES, "t", "deviation"), named) for x in data),
        *(
            (x, y.shape, y.shape == t.shape and not np.isinf(y).any(), shape)
            for x, y in rows.items()
        ),
        ("data", list(data), bool(rows), f"must have {known}"),
        ("deviation", deviation, positive, "must be > 0"),
        ("torque", None, scene.torque is not None, "must be in the scene, or be given as samples"),
    )
    assert scene.torque is not None
    values, columns = np.full((t.size, len(OBSERVABLES)), np.nan), [*map(OBSERVABLES.index, rows)]
    values[:, columns] = np.transpose(list(rows.values()))
    spread = None if deviation is None else np.ones_like(values)
    if spread is not None:
        spread[:, columns] = deviation
    return scene.torque, (t, values, spread)
