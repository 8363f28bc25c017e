# SPDX-License-Identifier: Apache-2.0
"""What was measured: angles and torques of the actuators.

Torques are samples at the times of the angles, or each is held over an interval, as a controller's
are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline

from sst_ros.errors import Problem, refusal
from sst_ros.scene import torque_profile as torques
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Rules, Section, build, entry
from sst_ros.simulation.trajectory import Trajectory
from sst_ros.state import Array, Quaternion

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording


Measured: TypeAlias = "Recording | Trajectory | Mapping[str, Any]"

FEWEST = 20  # samples to identify anything: filters and splines have transients at both ends
_HELD = (torques.TorqueTable, torques.ConstantTorque)


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


def read_motion(data: Measured) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays, see `identify`, or refuse it."""
    given = data if isinstance(data, Mapping) else _take_samples(data)
    known = {name: value for name, value in given.items() if value is not None}
    return build(MeasuredMotion, known, "identify")


def _take_samples(data: Recording | Trajectory) -> dict[str, Any]:
    """Take a simulated motion, or a recorded run while it has torques."""
    motion = data if isinstance(data, Trajectory) else getattr(data, "trajectory", None)
    if motion is None:
        allowed = "must be a recording or its path, a Trajectory, or a mapping of arrays"
        raise refusal("identify", "data", data, allowed)
    law, rows = motion.law, np.full(len(motion.t), True)
    if not isinstance(data, Trajectory):
        begins, ends = data.ticks.start_ns / 1e9, data.ticks.end_ns / 1e9
        rows = (motion.t >= begins[0] - 1e-12) & (motion.t <= ends[-1] + 1e-12)
        law = torques.TorqueTable(begins, data.ticks.torque)
    t, torque = motion.t[rows], motion.torque[rows]
    # With a lag the torques at the joints are behind those of the law: they are samples.
    held = not motion.scene.lags and (law is None or isinstance(law, _HELD))
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


def take_angles(data: Measured, scene: Scene) -> tuple[torques.TorqueProfile, Array, Array]:
    """Take the torques that move a scene, times from 0 on [s] (n,), and measured gamma (n, 3)."""
    measured = read_motion(data)
    t = measured.t - measured.t[0]
    if hasattr(data, "ticks"):  # a recording: torques before the lag, which the model has
        begins = np.round(data.ticks.start_ns / 1e9 - measured.t[0], 9)
        return torques.TorqueTable(begins, data.ticks.torque), t, measured.gamma
    # A simulated motion as well, while its torques are known: not of the state, and not lost.
    if isinstance(data, Trajectory) and data.t[0] == 0.0 and data.scene.lags <= scene.lags:
        law, limit = data.law, data.scene.torque_limit or np.inf
        if law and np.isfinite(values := law.values(t)).all():
            if limit == (scene.torque_limit or np.inf) or np.abs(values).max() <= limit:
                return law, t, measured.gamma
            held = isinstance(law, _HELD)  # cut off by a limit that the model has not
            acted = np.clip(_average(law, t) if held else values, -limit, limit)
            measured = replace(measured, torque=acted, held=held)
    if measured.held:
        return torques.TorqueTable(t[:-1], measured.torque), t, measured.gamma
    spline = CubicSpline(t, measured.torque)
    return torques.PolynomialTorque(spline.c, spline.x), t, measured.gamma
