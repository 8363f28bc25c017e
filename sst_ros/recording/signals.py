# SPDX-License-Identifier: Apache-2.0
"""All that a recording holds of a run, as tables: in memory, as pandas, CSV or Parquet.

Numbers have the bits of the recording. Any recording in which some topic of a run is found is read;
what it lacks is left out and named. `recording.read` makes a `Recording` of it, which refuses what
is not a whole run.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import Problem
from sst_ros.extras import require
from sst_ros.host.output import require_free, write_into
from sst_ros.host.table_file import write_table
from sst_ros.mechanism.geometry import Array
from sst_ros.recording.bag_reader import Bag, refusal
from sst_ros.recording.topic_tables import (
    DIAGNOSTICS,
    EULER,
    JOINT_STATES,
    ORIENTATION,
    SCENE,
    TABLES,
    TICKS,
    TIMES,
    TOPIC_TABLES,
    Column,
    InvalidMessage,
    TopicTable,
)
from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    import pandas as pd

Integers: TypeAlias = NDArray[np.int64]

FORMATS = ("csv", "parquet")


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

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def take(self, *names: str) -> Array:
        """Columns of quantities, as in "gamma_1", shape (n, number of names)."""
        names_of = [column.quantity for column in self.columns]
        return np.asarray(self.values[:, [names_of.index(name) for name in names]])

    @property
    def torque(self) -> Array:
        """Torques [N m] of a table that has some, shape (n, 3)."""
        return self.take("tau_1", "tau_2", "tau_3")

    def at(self, stamps_ns: Integers) -> Array:
        """Rows at these stamps, shape (m, columns); nan where there is none."""
        if np.array_equal(stamps_ns, self.stamp_ns):
            return self.values
        there = places(self.stamp_ns, stamps_ns)
        found = np.full((len(stamps_ns), self.values.shape[1]), np.nan)
        found[there >= 0] = self.values[there[there >= 0]]
        return found


def places(among_ns: Integers, times_ns: Integers) -> Integers:
    """Find where each time stands among ascending ones; -1 where it does not."""
    if not len(among_ns):
        return np.full(len(times_ns), -1)
    at = np.minimum(np.searchsorted(among_ns, times_ns), len(among_ns) - 1)
    return np.where(among_ns[at] == times_ns, at, -1)


@dataclass(frozen=True)
class Status:
    """One diagnostic status: when it was received [ns], its name, its values by key."""

    received_ns: int
    name: str
    values: dict[str, str]


@dataclass(frozen=True)
class Signals:
    """A run as columns.

    Attributes:
        path: of the recording.
        scene: what was simulated; None where it was not recorded.
        start_ns: stamp of the start of the run [ns].
        topic_series: rows of each topic that was recorded, by its key.
        idle_states: number of joint states that are no samples of the run.
        statuses: diagnostics, in order of reception.
        topics: full names of the topics found, by key.
        absent: why a topic is missing, by key.
        damage: what is damaged or lost, a line for each part; empty unless it was asked for.
        unverified: number of chunks without a checksum.

    """

    path: Path
    scene: Scene | None
    start_ns: int
    topic_series: dict[str, Series]
    idle_states: int
    statuses: tuple[Status, ...]
    topics: dict[str, str]
    absent: dict[str, Problem]
    damage: tuple[str, ...] = ()
    unverified: int = 0

    @cached_property
    def tables(self) -> dict[str, Series]:
        """Rows by the names of `TABLES`; only what was recorded."""
        result = {}
        for name, tables in TABLES.items():
            keys = [table.topic.key for table in tables]
            parts = [self.topic_series[key] for key in keys if key in self.topic_series]
            if parts:
                result[name] = _join(parts) if len(parts) > 1 else parts[0]
        return result

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Keys of the topics that are not in the recording, or without a row of the run."""
        keys = [table.topic.key for table in TOPIC_TABLES]
        found = [*self.topic_series, *([SCENE.key] if self.scene else [])]
        return tuple(key for key in (*keys, SCENE.key) if key not in found)

    def time_ns(self, table: str) -> Integers:
        """Time of each row since the start of the run [ns].

        Rows without a stamp have that of their reception by the recorder.
        """
        series = self.tables[table]
        stamps = np.where(series.stamp_ns > 0, series.stamp_ns, series.received_ns)
        return np.asarray(stamps - self.start_ns)

    def seconds(self, table: str = "samples") -> Array:
        """Time of each row since the start of the run [s]."""
        return np.asarray(self.time_ns(table) / NANOSECONDS)

    def legs(self, name: str, table: str = "samples") -> Array:
        """Columns of the three legs, as in "gamma" or "tau_feedback", shape (n, 3)."""
        return self.take(*(f"{name}_{leg}" for leg in (1, 2, 3)), table=table)

    def take(self, *names: str, table: str = "samples") -> Array:
        """Columns of quantities, shape (n, number of names)."""
        return self.tables[table].take(*names)

    def columns(self, table: str) -> dict[Column, NDArray[Any]]:
        """Columns of a table, times first, whole numbers where they are in ns.

        Raises:
            InputError: the recording has no such table.

        """
        if table not in self.tables:
            allowed = "must be one of those in the bag: " + ", ".join(self.tables)
            raise refusal(self.path, "table", table, allowed)
        series = self.tables[table]
        times = (self.time_ns(table), series.stamp_ns, series.received_ns)
        numbers = zip(series.columns, series.values.T, strict=True)
        return dict(zip(TIMES, times, strict=True)) | {
            column: values.astype(np.int64) if column.unit == "ns" else values
            for column, values in numbers
        }

    def table(self, name: str = "samples") -> pd.DataFrame:
        """Return a table as pandas, indexed by `time_ns`; `attrs` describes each column.

        Raises:
            InputError: the recording has no such table.
            MissingDependency: pandas is not installed.

        """
        columns = self.columns(name)
        numbers = {column.name: values for column, values in columns.items()}
        result: pd.DataFrame = require("pandas").DataFrame(numbers).set_index(TIMES[0].name)
        result.attrs = {column.name: column.text for column in columns}
        return result


def read(path: Path, *, damaged: bool = False) -> Signals:
    """Read a recording in one pass.

    Args:
        path: a rosbag2 recording, MCAP or sqlite3.
        damaged: read what is intact of a damaged recording; `Signals.damage` names the rest.

    Raises:
        InputError: there is no recording, it is damaged, or it has nothing of a run.

    """
    requested = [*(table.topic for table in TOPIC_TABLES), SCENE, DIAGNOSTICS]
    bag = Bag(path, requested, damaged=damaged)
    collected = {table.topic.key: _Rows(table) for table in TOPIC_TABLES}
    scenes: set[str] = set()
    statuses: list[Status] = []
    for key, received_ns, content in bag.messages():
        if key == SCENE.key:
            scenes.add(content.data)
        elif key == DIAGNOSTICS.key:
            for status in content.status:
                values = {pair.key: pair.value for pair in status.values}
                statuses.append(Status(received_ns, status.name, values))
        else:
            try:
                collected[key].add(received_ns, content)
            except InvalidMessage as error:
                raise refusal(path, key, error.value, str(error)) from None
    idle = collected[JOINT_STATES.topic.key].skipped
    series = {key: collected.pop(key).series(path) for key in list(collected)}
    found = {key: one for key, one in series.items() if len(one)}
    if not found:
        allowed = "must have at least one of " + ", ".join(t.topic.ending for t in TOPIC_TABLES)
        raise refusal(path, "topics", None, allowed)
    if len(scenes) > 1:
        raise refusal(path, "scene", len(scenes), "the recording must hold one scene")
    stamped = [table.topic.key for table in (*TABLES["samples"], TICKS)]
    starts = [int(found[key].stamp_ns[0]) for key in stamped if key in found]
    origin = f"{path}: {bag.topics.get(SCENE.key)}"
    return Signals(
        path=path,
        scene=yaml_document.read(Scene, scenes.pop(), origin) if scenes else None,
        start_ns=min(starts or [int(series.received_ns[0]) for series in found.values()]),
        topic_series=found,
        idle_states=idle,
        statuses=tuple(sorted(statuses, key=lambda status: status.received_ns)),
        topics=bag.topics,
        absent={one.key: bag.absence(one) for one in requested if one.key not in bag.topics},
        damage=bag.damage,
        unverified=bag.unverified,
    )


class _Rows:
    """The rows of one topic, kept compact: an hour at 500 Hz has 1.8 million of them."""

    def __init__(self, table: TopicTable) -> None:
        self._table = table
        self._stamps, self._received, self._values = array("q"), array("q"), array("d")
        self.skipped = 0

    def add(self, received_ns: int, content: Any) -> None:
        rows = self._table.rows(content)
        self.skipped += not rows
        for stamp, values in rows:
            self._stamps.append(stamp)
            self._received.append(received_ns)
            self._values.extend(values)

    def series(self, path: Path) -> Series:
        """Return the rows in order of time, one at each stamp."""
        columns = self._table.columns
        stamps = np.frombuffer(self._stamps, dtype=np.int64)
        received = np.frombuffer(self._received, dtype=np.int64)
        values = np.frombuffer(self._values, dtype=float).reshape(len(stamps), len(columns))
        key = stamps if self._table.stamped else received
        if np.any(key[1:] < key[:-1]):
            order = np.argsort(key, kind="stable")
            stamps, received, values = stamps[order], received[order], values[order]
        if self._table.stamped:
            again = np.flatnonzero(stamps[1:] == stamps[:-1])
            if self._table in (ORIENTATION, EULER):  # an idle state shows the last sample again
                again = again[~(values[again] == values[again + 1]).all(axis=1)]
            if len(again):
                allowed = f"stamp {stamps[again[0]]} ns comes twice; record one simulator a bag"
                raise refusal(path, self._table.topic.key, len(again), allowed)
            stays = np.append(True, stamps[1:] != stamps[:-1])[: len(stamps)]
            if not stays.all():
                stamps, received, values = stamps[stays], received[stays], values[stays]
        if self._table is TICKS and np.isnan(values[:, -3:]).all():
            columns, values = columns[:-3], values[:, :-3]  # no moment was recorded
        return Series(columns, stamps, received, values)


def _join(parts: Sequence[Series]) -> Series:
    """Put topics side by side at all stamps that any of them has."""
    stamps = np.unique(np.concatenate([part.stamp_ns for part in parts]))
    received = np.zeros(len(stamps), dtype=np.int64)
    for part in parts:
        at = np.searchsorted(stamps, part.stamp_ns)
        received[at] = np.where(received[at] > 0, received[at], part.received_ns)
    columns = tuple(column for part in parts for column in part.columns)
    return Series(columns, stamps, received, np.hstack([part.at(stamps) for part in parts]))


def frame(bag: str | Path, table: str = "samples") -> pd.DataFrame:
    """Read a table of a recording.

    Args:
        bag: a rosbag2 recording, MCAP or sqlite3.
        table: samples, ticks, commands, commands_stamped or external_moment.

    Returns:
        A row for each stamp, indexed by `time_ns` [ns] since the start of the run; columns bear
        their units, and `attrs` describes each.

    Raises:
        InputError: the recording cannot be read, or it has no such table.
        MissingDependency: pandas is not installed.

    """
    return read(Path(bag)).table(table)


def export(bag: Path, out: Path, form: str = FORMATS[0], *, force: bool = False) -> list[Path]:
    """Write a file for each table of a recording into the folder `out`; return their paths.

    Args:
        bag: a rosbag2 recording, MCAP or sqlite3.
        out: folder, made if it is not there.
        form: csv or parquet.
        force: replace earlier files.

    Raises:
        InputError: the recording cannot be read, `out` cannot be written or is not empty.
        MissingDependency: pandas or pyarrow is not installed.

    """
    require_free(out, "export", force=force)
    run = read(bag)
    paths = {name: out / f"{name}.{form}" for name in run.tables}
    with write_into(out, "export"):
        for name, path in paths.items():
            columns = run.columns(name)
            about = {one.name: {"unit": one.unit, "description": one.text} for one in columns}
            write_table({one.name: values for one, values in columns.items()}, path, about)
    return list(paths.values())
