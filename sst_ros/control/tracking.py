# SPDX-License-Identifier: Apache-2.0
"""Tracking metrics of a recorded or simulated motion, and their table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array

BAND = 0.02
"""Settling band: share of the largest range of a joint."""

ROWS = 10


@dataclass(frozen=True)
class TrackingRecord:
    """Reference, error and torques, by sample.

    Attributes:
        time: since the start of the motion or of the run [s], rising, shape (n,).
        gamma, gamma_dot: desired [rad], [rad/s], shape (n, 3).
        error, error_rate: desired - measured [rad], [rad/s], shape (n, 3).
        feedforward, feedback: parts of the controller's command [N m], shape (n, 3).
        torque: commanded or applied [N m], shape (n, 3).

    """

    time: Array
    gamma: Array
    gamma_dot: Array
    error: Array
    error_rate: Array
    feedforward: Array
    feedback: Array
    torque: Array


@dataclass(frozen=True)
class TrackingMetrics:
    """Metrics of a record. Those of joints have shape (3,).

    Attributes:
        samples: number of samples.
        seconds: from the first to the last [s].
        rms, largest, last: error [rad]: root of the mean square, largest, at the end.
        settling: time after the end of the motion after which the error stays in the band [s];
            None where it does not settle, or the record ends with the motion.
        band: settling band [rad], BAND times the largest range of a joint.
        torque_rms, torque_largest: effort [N m].
        feedforward, feedback: shares of the torque, mean of (part x torque) over mean of torque^2;
            what a limit has cut off makes their sum differ from 1. nan where there was no torque.
        limited: samples in which a torque was limited; None where that is not known.
        history: rows of time [s], rms and largest error of all joints up to then [rad], (m, 3).

    """

    samples: int
    seconds: float
    rms: Array
    largest: Array
    last: Array
    settling: float | None
    band: float
    torque_rms: Array
    torque_largest: Array
    feedforward: Array
    feedback: Array
    limited: int | None
    history: Array


def evaluate(track: TrackingRecord, limited: int | None = None) -> TrackingMetrics:
    """Return the metrics of a record of one sample or more; `limited` is passed on."""
    error, torque = np.abs(track.error), track.torque
    worst, square = error.max(axis=1), np.mean(error**2, axis=1)
    rms_so_far = np.sqrt(np.cumsum(square) / np.arange(1, len(square) + 1))
    so_far = np.stack([track.time, rms_so_far, np.maximum.accumulate(worst)], axis=1)
    shown = np.unique(np.linspace(0, len(worst) - 1, ROWS + 1).round().astype(int))
    power = np.mean(torque**2, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        feedforward = np.mean(track.feedforward * torque, axis=0) / power
        feedback = np.mean(track.feedback * torque, axis=0) / power
    band = BAND * float(np.ptp(track.gamma, axis=0).max())
    return TrackingMetrics(
        samples=len(worst),
        seconds=float(track.time[-1] - track.time[0]),
        rms=np.sqrt(np.mean(error**2, axis=0)),
        largest=error.max(axis=0),
        last=error[-1],
        settling=_settling(track, worst <= band),
        band=band,
        torque_rms=np.sqrt(power),
        torque_largest=np.abs(torque).max(axis=0),
        feedforward=feedforward,
        feedback=feedback,
        limited=limited,
        history=so_far[shown],
    )


def table(found: TrackingMetrics) -> str:
    """Return the metrics as text; what is unknown is a dash."""
    return "\n".join(_lines(found)) + "\n"


def _lines(found: TrackingMetrics) -> Iterator[str]:
    yield f"{'':24}{'gamma_1':>12}{'gamma_2':>12}{'gamma_3':>12}"
    for label, row in (
        ("error, RMS [rad]", found.rms),
        ("error, largest [rad]", found.largest),
        ("error at the end [rad]", found.last),
        ("torque, RMS [N m]", found.torque_rms),
        ("torque, largest [N m]", found.torque_largest),
    ):
        yield f"{label:24}" + "".join(f"{value:12.3e}" for value in row)
    for label, row in (("feedforward", found.feedforward), ("feedback", found.feedback)):
        cells = ("-" if np.isnan(share) else f"{100.0 * share:.2f}" for share in row)
        yield f"{label + ', share [%]':24}" + "".join(f"{cell:>12}" for cell in cells)
    settled = "-" if found.settling is None else f"{found.settling:.4f}"
    yield f"{'settling time [s]':24}{settled:>12}  (to {found.band:.2e} rad)"
    limited = "-" if found.limited is None else found.limited
    yield f"{'samples at a limit':24}{limited:>12}  (of {found.samples})"
    yield ""
    yield f"{'run time [s]':>16}{'RMS to then [rad]':>20}{'largest to then [rad]':>24}"
    for time, rms, largest in found.history:
        yield f"{time:16.4f}{rms:20.3e}{largest:24.3e}"


def _settling(track: TrackingRecord, inside: NDArray[np.bool_]) -> float | None:
    moving = np.flatnonzero(np.any(track.gamma_dot != 0.0, axis=1))
    end = int(moving[-1]) + 1 if len(moving) else 0
    if end >= len(inside) or not inside[-1]:
        return None
    outside = np.flatnonzero(~inside[end:])
    first = end + (int(outside[-1]) + 1 if len(outside) else 0)
    return float(track.time[first] - track.time[end])
