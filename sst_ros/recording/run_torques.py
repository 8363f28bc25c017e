# SPDX-License-Identifier: Apache-2.0
"""Torques of a recorded run: applied in each tick, and commanded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.bag_reader import refused
from sst_ros.recording.signals import Signals
from sst_ros.recording.time_series import Integers, Series, usual
from sst_ros.recording.topic_tables import COMMANDS, STAMPED_COMMANDS, TICKS


@dataclass(frozen=True)
class Commands:
    """Recorded commands in order of their reception.

    Attributes:
        received_ns: by the recorder's clock [ns], shape (c,).
        stamp_ns: stamp of the sample that is answered [ns]; 0 where commands have none, shape (c,).
        torque: commanded torques [N m], shape (c, 3).

    """

    received_ns: Integers
    stamp_ns: Integers
    torque: Array


@dataclass(frozen=True)
class Ticks:
    """Applied torques by tick, in order of time.

    Attributes:
        start_ns, end_ns: the tick, relative to the start of the run [ns], shape (m,).
        torque: actuator torques held over the tick [N m], shape (m, 3).
        moment: external moment on the star in {B} held over the tick [N m], shape (m, 3); None
            where it was not recorded.

    """

    start_ns: Integers
    end_ns: Integers
    torque: Array
    moment: Array | None = None

    @property
    def period_ns(self) -> int:
        """The usual length of a tick [ns]."""
        return usual(self.end_ns - self.start_ns)

    @property
    def gaps(self) -> int:
        """How often a tick does not begin where the one before ended."""
        return int(np.count_nonzero(self.start_ns[1:] != self.end_ns[:-1]))


def finite(found: Signals, key: str, width: int) -> Series:
    """Return the rows of a topic, none where it was not recorded; moments of ticks may be nan."""
    if key not in found.topic_series:
        empty = np.empty(0, dtype=np.int64)
        return Series((), empty, empty, np.empty((0, width)))
    series = found.topic_series[key]
    bad = ~np.isfinite(series.values[:, : 4 if key == TICKS.topic.key else None]).all(axis=1)
    if bad.any():
        stamp, row = int(series.stamp_ns[bad][0]), series.values[bad][0].tolist()
        raise refused(found.path, key, row, f"is not finite at stamp {stamp} ns")
    return series


def ticks_of(path: Path, series: Series, start_ns: int) -> Ticks:
    """Return the ticks of a run that starts at `start_ns`; they must not overlap."""
    starts = series.stamp_ns
    ends = starts + series.values[:, 0].astype(np.int64)
    overlap = starts[1:] < ends[:-1]
    if overlap.any():
        at = int(starts[1:][overlap][0])
        allowed = f"ticks overlap at stamp {at} ns; record one simulator a bag"
        raise refused(path, "applied_torques", at, allowed)
    moment = series.values[:, 4:]
    known = moment.shape[1] == 3 and bool(np.isfinite(moment).all())
    return Ticks(
        starts - start_ns, ends - start_ns, series.values[:, 1:4], moment if known else None
    )


def commands_of(found: Signals) -> Commands:
    """Put the commands of both topics in order of their reception."""
    keys = (COMMANDS.topic.key, STAMPED_COMMANDS.topic.key)
    parts = [found.topic_series[key] for key in keys if key in found.topic_series]
    if not parts:
        none = np.empty(0, dtype=np.int64)
        return Commands(none, none, np.empty((0, 3)))
    received = np.concatenate([part.received_ns for part in parts])
    stamps = np.concatenate([part.stamp_ns for part in parts])
    torque = np.concatenate([part.values for part in parts])
    order = np.argsort(received, kind="stable")
    return Commands(received[order], stamps[order], torque[order])
