# SPDX-License-Identifier: Apache-2.0
"""How well a recorded run followed its reference, from the bag alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.control.tracking import TrackingMetrics, TrackingRecord, evaluate
from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import continuation
from sst_ros.mechanism.frames import angle_between, quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording import recording
from sst_ros.recording.bag_reader import Bag, Topic, refused
from sst_ros.recording.recording import ACTUATED, Recording
from sst_ros.recording.time_series import NANOSECONDS, nanoseconds

TOPICS = (
    Topic("reference", "/reference", "sensor_msgs/msg/JointState", True),
    Topic("tracking_error", "/tracking_error", "sensor_msgs/msg/JointState", True),
    Topic("diagnostics", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", False, False),
)


@dataclass(frozen=True)
class Followed:
    """A recorded run that followed a reference; rows belong to the samples that have one.

    Attributes:
        recording: the run.
        track: what was wanted and what was missing.
        rows: which samples of the recording these are, shape (n,).
        orientation_error: angle between the orientation and that of the reference [rad], shape
            (n,); nan where it is not known.
        limited: samples in which a torque was limited, by the companion's last word; None where
            that was not recorded.

    """

    recording: Recording
    track: TrackingRecord
    rows: np.ndarray[Any, np.dtype[np.intp]]
    orientation_error: Array
    limited: int | None


def read(path: Path) -> Followed:
    """Read a rosbag2 recording of a run with the topics of the companion.

    Raises:
        InputError: it is no recording of a run that followed a reference, or a damaged one.

    """
    run = recording.read(path)
    found: dict[str, dict[int, Array]] = {"reference": {}, "tracking_error": {}}
    limited = None
    with Bag(path, TOPICS) as bag:
        for message in bag.messages():
            if message.key == "diagnostics":
                limited = _limited(message.content, limited)
            else:
                stamp, row = _row(path, message.key, message.content)
                found[message.key][stamp - run.start_ns] = row
    wanted = np.array(sorted(found["reference"].keys() & found["tracking_error"].keys()), dtype=int)
    times, rows, _ = np.intersect1d(run.time_ns, wanted, return_indices=True)
    if len(times) < 2:
        said = "two samples or more must have a reference"
        raise refused(path, "reference", len(times), said)
    reference, error = (
        np.array([found[key][time] for time in times.tolist()])
        for key in ("reference", "tracking_error")
    )
    gamma, gamma_dot, feedforward = np.split(reference, 3, axis=1)
    off, off_rate, feedback = np.split(error, 3, axis=1)
    track = TrackingRecord(
        time=times / NANOSECONDS,
        gamma=gamma,
        gamma_dot=gamma_dot,
        error=off,
        error_rate=off_rate,
        feedforward=feedforward,
        feedback=feedback,
        torque=_applied(run, times, feedforward + feedback),
    )
    return Followed(run, track, rows, _orientation_error(run, rows, gamma), limited)


def judged(followed: Followed) -> TrackingMetrics:
    """Put it in numbers."""
    return evaluate(followed.track, followed.limited)


def _row(path: Path, key: str, message: Any) -> tuple[int, Array]:
    names = list(message.name)
    parts = (message.position, message.velocity, message.effort)
    if sorted(names) != sorted(ACTUATED) or {len(part) for part in parts} != {3}:
        allowed = "must have position, velocity and effort of " + ", ".join(ACTUATED)
        raise refused(path, key, names, allowed)
    order = [names.index(name) for name in ACTUATED]
    stamp = message.header.stamp
    row = np.concatenate([np.asarray(part)[order] for part in parts])
    return nanoseconds(stamp), row


def _limited(message: Any, before: int | None) -> int | None:
    for status in message.status:
        values = {entry.key: entry.value for entry in status.values}
        if status.name.endswith(": control") and values.get("samples_limited", "").isdecimal():
            return int(values["samples_limited"])
    return before


def _applied(run: Recording, times: Array, asked: Array) -> Array:
    """Torque of the tick that begins at each sample; what was lost is what was asked for.

    A sample after the last tick has no torque.
    """
    ticks = run.ticks
    index = np.minimum(np.searchsorted(ticks.start_ns, times), len(ticks.start_ns) - 1)
    exact = (ticks.start_ns[index] == times)[:, None]
    torque = np.where(exact, ticks.torque[index], asked)
    torque[times >= ticks.end_ns[-1]] = 0.0
    return torque


def _orientation_error(run: Recording, rows: Any, gamma: Array) -> Array:
    """Follow the assembly of the run along the reference."""
    geometry, measured = Geometry.of(run.scene), run.quaternion[rows]
    unknown = np.full(len(rows), np.nan)
    if not np.isfinite(measured[0]).all():
        return unknown
    try:
        start = continuation.advance(
            geometry, rotation_matrix(measured[0]), run.gamma[rows[0]], gamma[0]
        )
        branch = continuation.follow(geometry, gamma, start)
    except SingularConfiguration:
        return unknown
    return angle_between(quaternion_of(branch.rotation), measured)
