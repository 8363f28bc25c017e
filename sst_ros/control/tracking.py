# SPDX-License-Identifier: Apache-2.0
"""Tracking metrics of a recorded or simulated motion, and their table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.mechanism.geometry import Array

BAND = 0.02
"""Settling band: share of the largest range of a joint."""

ROWS = 10

_KEPT = 4096
"""Rows of the history of a record that is added in parts: above it every other row goes."""


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

    @classmethod
    def of_rows(cls, rows: ArrayLike) -> TrackingRecord:
        """Return a record of rows of its 22 numbers, shape (n, 22) or flat, in the order above."""
        time, *columns = np.split(np.reshape(rows, (-1, 22)), range(1, 22, 3), axis=1)
        return cls(time[:, 0], *columns)


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


class TrackingSums:
    """Metrics of a record that comes part by part, of which a bounded number of rows is kept."""

    def __init__(self) -> None:
        self.samples = 0
        self._sums = np.zeros((4, 3))  # of error^2, torque^2, feedforward x torque, feedback x it
        self._largest = np.zeros((2, 3))  # error, torque
        self._lowest, self._highest = np.full(3, np.inf), np.full(3, -np.inf)
        self._first = self._last = 0.0
        self._last_error = np.zeros(3)
        self._end: float | None = None
        self._settled: float | None = None
        self._history, self._newest, self._stride = np.empty((0, 4)), np.empty(4), 1

    @property
    def rms(self) -> float:
        """Root of the mean square of all errors [rad]."""
        return float(np.sqrt(self._sums[0].sum() / (3 * max(self.samples, 1))))

    @property
    def largest(self) -> float:
        """Largest error [rad]."""
        return float(self._largest[0].max())

    def add(self, track: TrackingRecord) -> None:
        """Add the next part of the record, of one sample or more."""
        error, torque = np.abs(track.error), track.torque
        count = self.samples + np.arange(1, len(error) + 1)
        square = self._sums[0].mean() + np.cumsum(np.mean(error**2, axis=1))
        largest_error = error.max(axis=1)
        so_far = np.maximum(np.maximum.accumulate(largest_error), self.largest)
        rows = np.stack([count - 1, track.time, np.sqrt(square / count), so_far], axis=1)
        parts = error**2, torque**2, track.feedforward * torque, track.feedback * torque
        self._sums += [np.sum(part, axis=0) for part in parts]
        largest = error.max(axis=0), np.abs(torque).max(axis=0)
        self._largest = np.maximum(self._largest, largest)
        self._lowest = np.minimum(self._lowest, track.gamma.min(axis=0))
        self._highest = np.maximum(self._highest, track.gamma.max(axis=0))
        self._settle(track, largest_error <= self._band())
        self._first = self._first if self.samples else float(track.time[0])
        self._last, self._last_error = float(track.time[-1]), error[-1]
        while len(self._history) > _KEPT:
            self._history, self._stride = self._history[::2], 2 * self._stride
        self._history = np.vstack([self._history, rows[rows[:, 0] % self._stride == 0.0]])
        self._newest, self.samples = rows[-1], int(count[-1])

    def metrics(self, limited: int | None = None) -> TrackingMetrics:
        """Return the metrics of what was added; `limited` is passed on."""
        squares, powers, *shares = self._sums / self.samples
        with np.errstate(invalid="ignore", divide="ignore"):
            feedforward, feedback = (share / powers for share in shares)
        settling = None
        if self._end is not None and self._settled is not None:
            settling = self._settled - self._end
        requested = np.linspace(0, self.samples - 1, ROWS + 1).round()
        history = np.vstack([self._history, self._newest])
        shown = np.unique(np.searchsorted(history[:, 0], requested))
        return TrackingMetrics(
            samples=self.samples,
            seconds=self._last - self._first,
            rms=np.sqrt(squares),
            largest=self._largest[0],
            last=self._last_error,
            settling=settling,
            band=self._band(),
            torque_rms=np.sqrt(powers),
            torque_largest=self._largest[1],
            feedforward=feedforward,
            feedback=feedback,
            limited=limited,
            history=history[shown, 1:],
        )

    def _band(self) -> float:
        return BAND * float(np.max(self._highest - self._lowest))

    def _settle(self, track: TrackingRecord, inside: NDArray[np.bool_]) -> None:
        """Find the end of the motion, and since when the error has been inside the band."""
        moving = np.flatnonzero(np.any(track.gamma_dot != 0.0, axis=1))
        rest = int(moving[-1]) + 1 if len(moving) else 0
        if rest:
            self._end = self._settled = None
        if rest == len(inside):
            return
        if self._end is None:
            self._end = float(track.time[rest])
        outside = np.flatnonzero(~inside[rest:])
        first = rest + (int(outside[-1]) + 1 if len(outside) else 0)
        if len(outside):
            self._settled = None
        if self._settled is None and first < len(inside):
            self._settled = float(track.time[first])


def evaluate_tracking(track: TrackingRecord, limited: int | None = None) -> TrackingMetrics:
    """Return the metrics of a record of one sample or more; `limited` is passed on."""
    sums = TrackingSums()
    sums.add(track)
    return sums.metrics(limited)


def tracking_table(found: TrackingMetrics) -> str:
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
