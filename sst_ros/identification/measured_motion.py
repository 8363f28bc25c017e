# SPDX-License-Identifier: Apache-2.0
"""Measured actuator angles and torques, as identification takes them.

Torques are samples at the times of the angles, or each is held over an interval, as a controller's
are. Rates and accelerations follow by one of two methods (`derivatives`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene
from sst_ros.simulation.torque import TorqueTable
from sst_ros.simulation.torque_profile import ConstantTorque
from sst_ros.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from sst_ros.recording.recording import Recording

Measured: TypeAlias = "Recording | Trajectory | Mapping[str, Any] | str | Path"

FEWEST = 20
"""Samples below which nothing is identified: filters and splines have transients at both ends."""

KEYS = ("t", "gamma", "gamma_dot", "torque", "held", "quaternion")


@dataclass(frozen=True)
class MeasuredMotion:
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


def measured_motion(
    data: Measured, scene: Scene | None = None, delay: float = 0.0
) -> MeasuredMotion:
    """Read a motion from a recording, a trajectory, or arrays.

    Args:
        data: a recording or its path, a trajectory, or a mapping with t [s] (n,), gamma [rad]
            (n, 3), torque [N m] (n, 3), and where they are known gamma_dot [rad/s] (n, 3),
            quaternion (4,) at the first sample, and held: True where torque k acts from sample k
            to the next (n or n - 1 rows).
        scene: the manipulator, for the limit of its actuators.
        delay: time by which measured torques come late [s].

    Raises:
        InputError: shapes do not fit, numbers are not finite, times do not rise, or there are
            too few samples.

    """
    if isinstance(data, (str, Path)):
        from sst_ros.recording.recording import read  # needs rosbags, which other data do not

        data = read(data)
    if isinstance(data, Mapping):
        given = dict(data)
    elif isinstance(data, Trajectory):
        given = _of_trajectory(data)
    elif hasattr(data, "ticks"):
        given = _of_recording(data)
    else:
        allowed = "must be a recording or its path, a Trajectory, or a mapping of arrays"
        raise InputError("identify", [Problem("data", data, allowed)])
    t, gamma, torque, gamma_dot = _checked(given)
    quaternion = given.get("quaternion")
    held = bool(given.get("held", False))
    if held and len(torque) == len(t):
        torque = torque[:-1]
    if delay:
        torque = _shifted(t, torque, held, delay)
    limit = None if scene is None or scene.actuators is None else scene.actuators.torque_limit
    worst = np.abs(torque).max(axis=1)
    saturated = worst >= (np.inf if limit is None else limit * (1.0 - 1e-9))
    start = None if quaternion is None else np.asarray(quaternion, dtype=float)
    return MeasuredMotion(t, gamma, gamma_dot, torque, start, saturated)


def _of_trajectory(motion: Trajectory) -> dict[str, Any]:
    """Take a simulated motion; torques without a law are held to their sample, see `Trajectory`."""
    given = {
        "t": motion.t, "gamma": np.unwrap(motion.gamma, axis=0), "gamma_dot": motion.gamma_dot,
        "torque": motion.torque, "quaternion": motion.quaternion[0] if len(motion) else None,
    }  # fmt: skip
    if isinstance(motion.law, (TorqueTable, ConstantTorque)):
        given |= {"torque": _means(motion.law.values, motion.law.breaks(), motion.t), "held": True}
    elif motion.law is None:
        given |= {"torque": motion.torque[1:], "held": True}
    return given


def _of_recording(recording: Recording) -> dict[str, Any]:
    """Take a recorded run from the first sample that has an orientation and a torque after it."""
    ticks, times = recording.ticks, recording.seconds
    known = np.isfinite(recording.quaternion).all(axis=1)
    begins, ends = ticks.start_ns / 1e9, ticks.end_ns / 1e9
    inside = known & (times >= begins[0] - 1e-12) & (times <= ends[-1] + 1e-12)
    table = TorqueTable(begins, ticks.torque)
    if recording.scene.actuators is not None and recording.scene.actuators.time_constant:
        # The lag is between the tick's torque and the joint; the recorded effort is behind it.
        torque: dict[str, Any] = {"torque": recording.effort[inside]}
    else:
        means = _means(table.values, table.breaks(), times[inside])
        torque = {"torque": means, "held": True}
    return {
        "t": times[inside], "gamma": np.unwrap(recording.gamma[inside], axis=0),
        "gamma_dot": recording.gamma_dot[inside],
        "quaternion": recording.quaternion[inside][0] if inside.any() else None, **torque,
    }  # fmt: skip


def _means(values: Any, breaks: Array, t: Array) -> Array:
    """Means over the intervals of t of a torque that is constant between its breaks, (n - 1, 3)."""
    if len(t) < 2:
        return np.empty((0, 3))
    edges = np.union1d(t, breaks[(breaks > t[0]) & (breaks < t[-1])])
    middle = 0.5 * (edges[1:] + edges[:-1])
    areas = np.asarray(values(middle)) * np.diff(edges)[:, None]
    total = np.vstack([np.zeros(3), np.cumsum(areas, axis=0)])
    at = np.searchsorted(edges, t)
    # Sums over one interval each: a difference of long sums would lose digits.
    if len(edges) == len(t):
        return np.asarray(areas / np.diff(edges)[:, None])
    return np.asarray(np.diff(total[at], axis=0) / np.diff(t)[:, None])


def _shifted(t: Array, torque: Array, held: bool, delay: float) -> Array:
    """Torques as they acted, `delay` earlier than they were measured; the last ones are held."""
    if held:
        total = np.vstack([np.zeros(3), np.cumsum(torque * np.diff(t)[:, None], axis=0)])
        late = np.stack([np.interp(t + delay, t, column) for column in total.T], axis=1)
        return np.asarray(np.diff(late, axis=0) / np.diff(t)[:, None])
    return np.stack([np.interp(t + delay, t, column) for column in torque.T], axis=1)


def _checked(given: Mapping[str, Any]) -> tuple[Array, Array, Array, Array | None]:
    """Arrays of a mapping.

    Raises:
        InputError: lists every fault.

    """
    problems = [Problem(key, given[key], f"must be one of {', '.join(KEYS)}")
                for key in given if key not in KEYS]  # fmt: skip
    arrays: dict[str, Array] = {}
    for key in ("t", "gamma", "torque", "gamma_dot", "quaternion"):
        value = given.get(key)
        if value is None:
            if key in ("t", "gamma", "torque"):
                problems.append(Problem(key, None, "must be given"))
            continue
        try:
            arrays[key] = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            problems.append(Problem(key, value, "must be numbers"))
            continue
        if not np.all(np.isfinite(arrays[key])):
            bad = np.argwhere(~np.isfinite(arrays[key]))[0]
            problems.append(Problem(f"{key}{bad.tolist()}", "not finite", "must be finite numbers"))
    if not problems:
        problems += _misfits(arrays, bool(given.get("held", False)))
    if problems:
        raise InputError("identify", problems)
    return arrays["t"], arrays["gamma"], arrays["torque"], arrays.get("gamma_dot")


def _misfits(arrays: Mapping[str, Array], held: bool) -> Iterator[Problem]:
    t = arrays["t"]
    if t.ndim != 1 or np.any(np.diff(t) <= 0.0):
        yield Problem("t", t, "must be rising times [s], shape (n,)")
        return
    if len(t) < FEWEST:
        yield Problem("t", len(t), f"must be {FEWEST} samples or more")
    for name, shapes in (
        ("gamma", ((len(t), 3),)), ("gamma_dot", ((len(t), 3),)), ("quaternion", ((4,),)),
        ("torque", ((len(t), 3), (len(t) - 1, 3)) if held else ((len(t), 3),)),
    ):  # fmt: skip
        if name in arrays and arrays[name].shape not in shapes:
            yield Problem(name, arrays[name].shape, f"must have the shape {shapes[0]}")
