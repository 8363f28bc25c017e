# SPDX-License-Identifier: Apache-2.0
"""Stamped rows of numbers: rows at given stamps, places of stamps, the usual period."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.topic_tables import Column
from sst_ros.state import NANOSECONDS as NANOSECONDS

Integers: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True)
class Series:
    """Rows of one table: of one topic, or of all topics at the stamps of samples.

    Attributes:
        columns: what the numbers are.
        stamp_ns: stamps of the messages [ns], shape (n,); 0 where they have none.
        received_ns: reception by the recorder, by its clock [ns], shape (n,); 0 where it failed.
        values: shape (n, number of columns); nan where a message was lost.

    """

    columns: tuple[Column, ...]
    stamp_ns: Integers
    received_ns: Integers
    values: Array


def aligned(wanted_ns: Integers, stamps_ns: Integers, rows: Array) -> Array:
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
