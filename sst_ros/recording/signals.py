# SPDX-License-Identifier: Apache-2.0
"""All that a bag holds of a run, as columns; what it lacks is left out and named.

`recording.read` is for judging: it refuses what is not a whole run. This is for looking: it takes
any bag in which some topic of a run is found.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording import cdr_fields
from sst_ros.recording.bag_reader import Bag, refused
from sst_ros.recording.mcap_blocks import Block
from sst_ros.recording.time_series import NANOSECONDS, Integers
from sst_ros.recording.topic_tables import SAMPLES, SCENE, SOURCES, TABLES, TICKS, Column, Source
from sst_ros.scene import yaml_document
from sst_ros.scene.scene import Scene


@dataclass(frozen=True)
class Series:
    """Rows of one table: of one topic, or of all topics at the stamps of samples.

    Attributes:
        columns: what the numbers are.
        stamp_ns: stamps of the messages [ns], shape (n,); 0 where they have none.
        received_ns: when the recorder got them, by its clock [ns], shape (n,); 0 where it did not.
        values: shape (n, number of columns); nan where a message was lost.

    """

    columns: tuple[Column, ...]
    stamp_ns: Integers
    received_ns: Integers
    values: Array


@dataclass(frozen=True)
class Signals:
    """A run as tables.

    Attributes:
        path: where the bag is.
        scene: what was simulated; None where it was not recorded.
        start_ns: stamp of the start of the run [ns].
        tables: rows by the names of `contents.TABLES`; only what was recorded.
        missing: keys of the topics that are not in the bag, or in it without a message of the run.

    """

    path: Path
    scene: Scene | None
    start_ns: int
    tables: dict[str, Series]
    missing: tuple[str, ...]

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

    def has(self, *names: str, table: str = "samples") -> bool:
        """Tell whether there are columns of these quantities, as in "gamma_1"."""
        return all(self._places(name, table) for name in names)

    def legs(self, name: str, table: str = "samples") -> Array:
        """Columns of the three legs, as in "gamma" or "tau_feedback", shape (n, 3)."""
        return self.take(*(f"{name}_{leg}" for leg in (1, 2, 3)), table=table)

    def take(self, *names: str, table: str = "samples") -> Array:
        """Columns of quantities, shape (n, number of names)."""
        at = [place for name in names for place in self._places(name, table)]
        return np.asarray(self.tables[table].values[:, at])

    def _places(self, name: str, table: str) -> list[int]:
        series = self.tables.get(table)
        found = enumerate(series.columns if series else ())
        return [place for place, column in found if column.quantity == name]


def read(path: Path) -> Signals:
    """Read what there is.

    Raises:
        InputError: there is no bag, it is damaged, or it has nothing of a run.

    """
    collected = {source.topic.key: _Collected(source) for source in SOURCES}
    scenes: set[str] = set()
    with Bag(path, [*(source.topic for source in SOURCES), SCENE]) as bag:
        for block in bag.blocks() if bag.topics else ():
            if block.topic == SCENE.key:
                scenes |= {message.data for message in bag.content(block)}
                continue
            try:
                collected[block.topic].add(block)
            except cdr_fields.Malformed as error:
                raise bag.damaged(error, f" in {block.topic}") from None
            except (ValueError, IndexError):
                allowed = "a message lacks joints, or numbers for them"
                raise refused(path, block.topic, None, allowed) from None
    found = {key: rows.series(path) for key, rows in collected.items() if rows.count}
    if not found:
        allowed = "must have at least one of " + ", ".join(s.topic.ending for s in SOURCES)
        raise refused(path, "topics", None, allowed)
    tables = {}
    for name, sources in TABLES.items():
        parts = [found[source.topic.key] for source in sources if source.topic.key in found]
        if parts:
            tables[name] = _together(parts) if len(parts) > 1 else parts[0]
    scene = _scene(path, scenes)
    missing = [source.topic.key for source in SOURCES if source.topic.key not in found]
    return Signals(
        path=path,
        scene=scene,
        start_ns=_start(tables),
        tables=tables,
        missing=tuple(missing if scene else [*missing, SCENE.key]),
    )


class _Collected:
    """The rows of one topic, kept compact."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._parts: list[tuple[Integers, Integers, Array]] = []

    @property
    def count(self) -> int:
        return sum(len(stamps) for stamps, _, _ in self._parts)

    def add(self, block: Block) -> None:
        for received, rows in cdr_fields.read(block.received, block.rows, self._source.fields):
            for stamps, values in rows:
                # A stamp of zero is a preview, which belongs to no run.
                kept = stamps != 0 if self._source in (*SAMPLES, TICKS) else stamps >= 0
                self._parts.append((stamps[kept], received[kept], values[kept]))

    def series(self, path: Path) -> Series:
        told = self._source.columns
        stamps, received, values = map(np.concatenate, zip(*self._parts, strict=True))
        stamped = self._source in (*SAMPLES, TICKS)
        order = np.argsort(stamps if stamped else received, kind="stable")
        stamps, received, values = stamps[order], received[order], values[order]
        if stamped:
            again = stamps[1:] == stamps[:-1]
            if again.any():
                twice = int(stamps[1:][again][0])
                allowed = f"stamp {twice} ns comes twice; record one simulator a bag"
                raise refused(path, self._source.topic.key, twice, allowed)
        if self._source is TICKS and np.isnan(values[:, -3:]).all():
            told, values = told[:-3], values[:, :-3]  # no moment was recorded
        return Series(told, stamps, received, values)


def _together(parts: list[Series]) -> Series:
    """Put topics side by side at all stamps that any of them has."""
    stamps = np.unique(np.concatenate([part.stamp_ns for part in parts]))
    received = np.zeros(len(stamps), dtype=np.int64)
    values = []
    for part in parts:
        at = np.searchsorted(stamps, part.stamp_ns)
        whole = np.full((len(stamps), len(part.columns)), np.nan)
        whole[at] = part.values
        values.append(whole)
        received[at] = np.where(received[at] > 0, received[at], part.received_ns)
    told = tuple(column for part in parts for column in part.columns)
    return Series(told, stamps, received, np.concatenate(values, axis=1))


def _start(tables: dict[str, Series]) -> int:
    firsts = [tables[name].stamp_ns[0] for name in ("samples", "ticks") if name in tables]
    others = [int(table.received_ns[0]) for table in tables.values()]
    return int(min(firsts)) if firsts else min(others)


def _scene(path: Path, texts: set[str]) -> Scene | None:
    if len(texts) > 1:
        raise refused(path, "scene", len(texts), "the recording must hold one scene")
    return yaml_document.read(Scene, texts.pop(), f"{path}: scene") if texts else None
