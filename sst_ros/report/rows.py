# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers from messages: collected compactly, put in order, checked."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array
from sst_ros.report.bag import refused

Integers = NDArray[np.int64]

NANOSECONDS = 1_000_000_000


class Rows:
    """Stamped rows of numbers, kept compact: an hour at 500 Hz has 1.8 million of them."""

    def __init__(self, path: Path, topic: str, width: int) -> None:
        self._path, self._topic, self._width = path, topic, width
        self._stamps, self._received, self._values = array("q"), array("q"), array("d")

    def add(self, received_ns: int, stamp_ns: int, values: Sequence[float]) -> None:
        """Append one row."""
        self._stamps.append(stamp_ns)
        self._received.append(received_ns)
        self._values.extend(values)

    def sorted(self) -> tuple[Integers, Integers, Array]:
        """Return stamps, receive times [ns] and values in order of the stamps.

        Raises:
            InputError: a value is not finite, or two rows have one stamp.

        """
        stamps = np.array(self._stamps, dtype=np.int64)
        values = np.array(self._values, dtype=float).reshape(-1, self._width)
        order = np.argsort(stamps, kind="stable")
        stamps, values = stamps[order], values[order]
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            stamp, row = int(stamps[bad][0]), values[bad][0].tolist()
            raise refused(self._path, self._topic, row, f"is not finite at stamp {stamp} ns")
        twice = np.flatnonzero(stamps[1:] == stamps[:-1])
        if len(twice):
            allowed = f"stamp {stamps[twice[0]]} ns comes twice; record one simulator a bag"
            raise refused(self._path, self._topic, len(twice), allowed)
        return stamps, np.array(self._received, dtype=np.int64)[order], values


def aligned(wanted_ns: Integers, stamps_ns: Integers, _: Integers, rows: Array) -> Array:
    """Pick the rows at the wanted stamps; nan where there is none."""
    result = np.full((len(wanted_ns), rows.shape[1]), np.nan)
    _, here, there = np.intersect1d(wanted_ns, stamps_ns, True, True)
    result[here] = rows[there]
    return result


def usual(lengths_ns: Integers) -> int:
    """Return the most frequent length, the shortest where several are."""
    values, counts = np.unique(lengths_ns, return_counts=True)
    return int(values[np.argmax(counts)])


def nanoseconds(stamp: Any) -> int:
    """Return a Time or Duration as one number [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
