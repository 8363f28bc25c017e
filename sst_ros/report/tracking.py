# SPDX-License-Identifier: Apache-2.0
"""How well a recorded run followed its reference, from the bag alone."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sst_ros.control.controller import Track, TrackingMetrics, track_of
from sst_ros.errors import InputError, SingularConfiguration, refusal
from sst_ros.mechanism import continuation
from sst_ros.mechanism.geometry import (
    Geometry,
    angle_between,
    quaternion_of,
    rotation_matrix,
)
from sst_ros.plot import pictures
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import (
    REFERENCE_TABLE,
    TRACKING_ERROR,
    Integers,
    Series,
    places,
)
from sst_ros.report.results import largest, publish, render
from sst_ros.state import NANOSECONDS, Array, cached_property

TRACKING_TOPICS = (REFERENCE_TABLE.key, TRACKING_ERROR.key)
TRACKING_DRAWN = ("tracking", "tracking_error", "control_torques")
"""Pictures of `plot` that the report has, too."""


@dataclass(frozen=True)
class TrackedRun:
    """A recorded run that followed a reference.

    Rows belong to the samples that have one.
    """

    recording: Recording
    track: Track  # reference, tracking error and torques
    rows: NDArray[np.intp]  # which samples of the recording these are, (n,)

    @property
    def metrics(self) -> TrackingMetrics:
        """Metrics of the run.

        How often a torque was limited is in the last diagnostics of the controller.
        """
        signals = self.recording.signals
        limited = None
        for status in signals.statuses_of("control", REFERENCE_TABLE.key):
            count = status.values.get("samples_limited", "")
            if count.isdecimal():
                limited = int(count)  # the last one that was reported
        return TrackingMetrics(self.track, limited)

    @cached_property
    def orientation_error(self) -> Array:
        """Angle between the orientation and that of the reference [rad], shape (n,).

        The assembly of the run is followed along the reference; nan where it is not
        known.
        """
        run = self.recording
        gamma = self.track.gamma
        geometry = Geometry.of(run.scene)
        recorded = run.quaternion[self.rows]
        if np.isfinite(recorded[0]).all():
            with suppress(SingularConfiguration):
                first = rotation_matrix(recorded[0])
                begin = run.exact_gamma[self.rows[0]]
                start = continuation.advance(geometry, first, begin, gamma[0])
                expected, _ = continuation.follow(geometry, gamma, start)
                return angle_between(quaternion_of(expected), recorded)
        return np.full(len(gamma), np.nan)


def read_tracking(path: Path) -> TrackedRun:
    """Read a rosbag2 recording of a run with a controller.

    It has the topics of the inverse-dynamics controller. Raises InputError where it is
    no recording of a run that followed a reference, or a damaged one.
    """
    run = recording.read(path)
    missing = run.signals.absent
    absent = [missing[key] for key in TRACKING_TOPICS if key in missing]
    if absent:
        raise InputError(str(path), absent)
    tracked = of(run)
    if tracked is None:
        raise refusal(
            path, TRACKING_TOPICS[0], 0, "two samples or more must have a reference"
        )
    return tracked


def of(run: Recording) -> TrackedRun | None:
    """Return reference and tracking error of a run.

    None where fewer than two samples have one.
    """
    reference, error = (run.signals.topic_series[key] for key in TRACKING_TOPICS)
    stamps = run.time_ns + run.start_ns
    in_reference = places(reference.stamp_ns, stamps)
    in_error = places(error.stamp_ns, stamps)
    rows = np.flatnonzero((in_reference >= 0) & (in_error >= 0))
    if len(rows) < 2:
        return None
    # In the order of the columns of REFERENCE_TABLE and TRACKING_ERROR.
    gamma, gamma_dot, feedforward = _split(reference, in_reference[rows])
    gamma_error, _, feedback = _split(error, in_error[rows])
    times = run.time_ns[rows]
    # The torque of the tick that begins at a sample; what was lost is what was
    # requested. A sample after the last tick has none.
    tick = places(run.ticks.start_ns, times)
    has_tick = (tick >= 0)[:, None]
    torque = np.where(has_tick, run.ticks.torque[tick], feedforward + feedback)
    torque[times >= run.ticks.end_ns[-1]] = 0.0
    seconds = times[:, None] / NANOSECONDS
    columns = seconds, gamma, gamma_dot, gamma_error, feedforward, feedback, torque
    return TrackedRun(run, track_of(np.hstack(columns)), rows)


def _split(series: Series, rows: Integers) -> list[Array]:
    """Return angles, rates and torques of some rows, each shape (n, 3)."""
    return np.split(series.values[rows], 3, axis=1)


def write_tracking_report(bag: Path, folder: Path) -> str:
    """Evaluate how a recorded run followed its reference.

    Table and pictures are written into a folder. The table is returned. Raises
    InputError as `read_tracking`, or where the folder cannot be written.
    """
    tracked = read_tracking(bag)
    title = f"Tracking of {tracked.recording.scene.name}, from {bag}"
    text = render(
        "tracking.txt",
        title=title,
        found=tracked.metrics,
        turned=largest(tracked.orientation_error),
    )
    publish(folder, "report", {"tracking.txt": text})
    pictures.draw_run(tracked.recording.signals, folder, TRACKING_DRAWN, ["png"])
    return text
