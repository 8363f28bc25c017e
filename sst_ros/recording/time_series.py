# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers from messages: collected compactly, put in order, checked."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.bag_reader import refused

Integers = NDArray[np.int64]

NANOSECONDS = 1_000_000_000


class Rows:
    """Stamped rows of numbers, kept compact: an hour at 500 Hz has 1.8 million of them.

    Args:
        path, topic: for the words of errors.
        width: numbers in a row.
        received: keep when they were received.

    """

    def __init__(self, path: Path, topic: str, width: int, *, received: bool = False) -> None:
        self._path, self._topic, self._width = path, topic, width
        self._stamps, self._values = array("q"), array("d")
        self._received = array("q") if received else None

    def add(self, received_ns: Integers, stamp_ns: Integers, values: Array) -> None:
        """Append rows, shapes (n,), (n,) and (n, width)."""
        self._stamps.frombytes(np.ascontiguousarray(stamp_ns, dtype=np.int64).tobytes())
        self._values.frombytes(np.ascontiguousarray(values, dtype=float).tobytes())
        if self._received is not None:
            self._received.frombytes(np.ascontiguousarray(received_ns, dtype=np.int64).tobytes())

    def sorted(self) -> tuple[Integers, Integers, Array]:
        """Return stamps, receive times [ns] and values in order of the stamps.

        Raises:
            InputError: a value is not finite, or two rows have one stamp.

        """
        stamps, received, values = self.unsorted()
        if np.any(stamps[1:] < stamps[:-1]):
            order = np.argsort(stamps, kind="stable")
            stamps, values = stamps[order], values[order]
            received = received[order] if len(received) else received
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            stamp, row = int(stamps[bad][0]), values[bad][0].tolist()
            raise refused(self._path, self._topic, row, f"is not finite at stamp {stamp} ns")
        twice = np.flatnonzero(stamps[1:] == stamps[:-1])
        if len(twice):
            allowed = f"stamp {stamps[twice[0]]} ns comes twice; record one simulator a bag"
            raise refused(self._path, self._topic, len(twice), allowed)
        return stamps, received, values

    def unsorted(self) -> tuple[Integers, Integers, Array]:
        """Return stamps, receive times [ns], none where they were not kept, and values."""
        return (
            np.frombuffer(self._stamps, dtype=np.int64),
            np.frombuffer(self._received or b"", dtype=np.int64),
            np.frombuffer(self._values, dtype=float).reshape(-1, self._width),
        )


def aligned(wanted_ns: Integers, stamps_ns: Integers, _: Integers, rows: Array) -> Array:
    """Pick the rows at the wanted stamps; nan where there is none."""
    if np.array_equal(wanted_ns, stamps_ns):
        return rows
    result = np.full((len(wanted_ns), rows.shape[1]), np.nan)
    there = places(stamps_ns, wanted_ns)
    result[there >= 0] = rows[there[there >= 0]]
    return result


def places(among_ns: Integers, wanted_ns: Integers) -> Integers:
    """Find where each wanted time stands among ascending ones; -1 where it does not."""
    if not len(among_ns):
        return np.full(len(wanted_ns), -1)
    at = np.minimum(np.searchsorted(among_ns, wanted_ns), len(among_ns) - 1)
    return np.where(among_ns[at] == wanted_ns, at, -1)


def usual(lengths_ns: Integers) -> int:
    """Return the most frequent length, the shortest where several are."""
    values, counts = np.unique(lengths_ns, return_counts=True)
    return int(values[np.argmax(counts)])


def nanoseconds(stamp: Any) -> int:
    """Return a Time or Duration as one number [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
