# SPDX-License-Identifier: Apache-2.0
"""Long runs drawn with few points: of every stretch the least and the largest value stay.

No spike is lost, and a gap (nan) stays a gap; what goes is what no picture could show.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.recording import Recording, Ticks
from sst_ros.recording.time_series import Integers
from sst_ros.report.reference import Comparison, Deviation

STRETCHES = 700
"""Each gives two points or more: a picture is about a thousand wide."""


def extremes(curves: Iterable[Array], count: int) -> Integers:
    """Rows that stay of curves of `count` values each: ascending, the first and the last in it."""
    size = -(-count // STRETCHES)
    if size <= 4:
        return np.arange(count)
    stay = np.zeros(count, dtype=bool)
    stay[[0, -1]] = True
    begins = np.arange(0, count, size)
    for curve in curves:
        padded = np.full(len(begins) * size, np.nan)
        padded[:count] = curve
        stretches = padded.reshape(-1, size)
        lost = np.isnan(stretches)
        for filled in (np.where(lost, -np.inf, stretches), -np.where(lost, np.inf, stretches)):
            stay[np.minimum(begins + filled.argmax(axis=1), count - 1)] = True
        gaps = lost.any(axis=1)
        stay[np.minimum(begins + lost.argmax(axis=1), count - 1)[gaps]] = True
    return np.flatnonzero(stay)


def thinned(
    recording: Recording, integration: Comparison, ideal: Comparison | None
) -> tuple[Recording, Comparison, Comparison | None]:
    """Return a run with few samples and ticks, for drawing."""
    count = len(recording.time_ns)
    compared = [integration] if ideal is None else [integration, ideal]
    deviations = (field for both in compared for field in (*_fields(both.error), floor(both.own)))
    measured = _columns((recording.quaternion, recording.euler))
    rows = extremes(itertools.chain(measured, deviations), count)
    few: dict[str, Any] = {
        field.name: value[rows]
        for field in dataclasses.fields(recording)
        if isinstance(value := getattr(recording, field.name), np.ndarray)
    }
    found = [
        dataclasses.replace(both, error=_taken(both.error, rows), own=_taken(both.own, rows))
        for both in compared
    ]
    short = dataclasses.replace(recording, **few, ticks=_ticks(recording.ticks))
    return short, found[0], found[1] if ideal else None


def floor(own: Deviation) -> Array:
    """Largest of the reference's own errors, below which nothing can be told, shape (n,)."""
    return np.asarray(np.fmax(np.fmax(own.gamma, own.gamma_dot), own.orientation))


def _ticks(ticks: Ticks) -> Ticks:
    """Ticks that stay hold until the next one that does; where some were lost they end there."""
    count = len(ticks.start_ns)
    rows = extremes(_columns([ticks.torque]), count)
    if len(rows) == count:
        return ticks
    gap = np.flatnonzero(ticks.start_ns[1:] != ticks.end_ns[:-1])
    rows = np.union1d(rows, np.union1d(gap, gap + 1))
    lost = np.isin(rows, gap)
    lost[-1] = True
    following = np.append(ticks.start_ns[rows[1:]], 0)
    ends = np.where(lost, ticks.end_ns[rows], following)
    moment = None if ticks.moment is None else ticks.moment[rows]
    return Ticks(ticks.start_ns[rows], ends, ticks.torque[rows], moment)


def _columns(blocks: Iterable[Array]) -> Iterable[Array]:
    return (column for block in blocks for column in block.T)


def _fields(deviation: Deviation) -> tuple[Array, ...]:
    return deviation.gamma, deviation.gamma_dot, deviation.orientation


def _taken(deviation: Deviation, rows: Integers) -> Deviation:
    return Deviation(*(values[rows] for values in _fields(deviation)))
