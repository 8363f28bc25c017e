# SPDX-License-Identifier: Apache-2.0
"""Tracking metrics of a recorded or simulated motion."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.mechanism.geometry import Array

BAND = 0.02  # settling band: share of the largest range of a joint

_PARTS = ("gamma", "gamma_dot", "error", "feedforward", "feedback", "torque")
TRACK = np.dtype([("time", float), *((name, float, 3) for name in _PARTS)])
"""A sample of a tracking record, 19 numbers: the time since the start of the motion or of the run
[s], gamma and gamma_dot as desired [rad], [rad/s], desired - measured gamma [rad], the two parts of
the controller's command [N m], and the torque that was commanded or applied [N m]."""

Track: TypeAlias = "np.recarray[Any, Any]"


def track_of(rows: ArrayLike) -> Track:
    """Return a tracking record, shape (n,) of TRACK, of numbers in its order, (n, 19) or flat."""
    return np.array(rows, dtype=float).reshape(-1).view(TRACK).view(np.recarray)


class TrackingMetrics:
    """Metrics of a tracking record, which may come part by part. Those of joints have shape (3,).

    Beside the properties: the number of `samples`, the `largest` and the `last` error [rad],
    `torque_largest` [N m], and `limited`, the samples in which a torque was limited, None where
    that is not known.
    """

    def __init__(self, track: Track | None = None, limited: int | None = None) -> None:
        self.samples, self.limited = 0, limited
        self.largest, self.torque_largest, self.last = np.zeros((3, 3))
        self._sums = np.zeros((4, 3))  # of error^2, torque^2, feedforward x torque, feedback x it
        self._lowest, self._highest = np.full(3, np.inf), np.full(3, -np.inf)
        self._rested: float | None = None  # when the motion ended
        self._settled: float | None = None  # since when the error has been inside the band
        if track is not None:
            self.add(track)

    def add(self, track: Track) -> None:
        """Add the next part of the record, of one sample or more."""
        error, torque = np.abs(track.error), track.torque
        parts = error**2, torque**2, track.feedforward * torque, track.feedback * torque
        self._sums += [np.sum(part, axis=0) for part in parts]
        self.largest = np.maximum(self.largest, error.max(axis=0))
        self.torque_largest = np.maximum(self.torque_largest, np.abs(torque).max(axis=0))
        self._lowest = np.minimum(self._lowest, track.gamma.min(axis=0))
        self._highest = np.maximum(self._highest, track.gamma.max(axis=0))
        moving = np.any(track.gamma_dot != 0.0, axis=1)
        self._rested = _since(self._rested, moving, track.time)
        away = moving | (error.max(axis=1) > self.band)
        self._settled = _since(self._settled, away, track.time)
        self.last, self.samples = error[-1], self.samples + len(error)

    @property
    def rms(self) -> Array:
        """Root of the mean square of the error [rad]; 0 without a sample."""
        return np.asarray(np.sqrt(self._sums[0] / max(self.samples, 1)))

    @property
    def torque_rms(self) -> Array:
        """Root of the mean square of the torque [N m]; 0 without a sample."""
        return np.asarray(np.sqrt(self._sums[1] / max(self.samples, 1)))

    @property
    def shares(self) -> Array:
        """Shares of feedforward and feedback in the torque, shape (2, 3); nan without a torque.

        The mean of (part x torque) over the mean of torque^2; what a limit has cut off makes their
        sum differ from 1.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self._sums[2:] / self._sums[1])

    @property
    def band(self) -> float:
        """Settling band [rad], BAND times the largest range of a joint."""
        return BAND * float(np.max(self._highest - self._lowest))

    @property
    def settling(self) -> float | None:
        """Time after the end of the motion after which the error stays in the band [s].

        None where it does not settle, or the record ends with the motion.
        """
        if self._rested is None or self._settled is None:
            return None
        return self._settled - self._rested


def _since(known: float | None, wrong: NDArray[np.bool_], time: Array) -> float | None:
    """Return since when nothing has been wrong, behind the next part; None where its end is."""
    if known is not None and not wrong.any():
        return known
    rest = int(np.max(np.flatnonzero(wrong), initial=-1)) + 1
    return float(time[rest]) if rest < len(time) else None
