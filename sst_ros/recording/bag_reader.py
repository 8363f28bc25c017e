# SPDX-License-Identifier: Apache-2.0
"""The messages of a rosbag2 recording in one pass; every fault of it becomes an InputError.

mcap reads MCAP and checks each chunk by its CRC-32; rosbags knows the types of the messages. A
database is read as such: rosbags refuses one with an action, whose definitions rosbag2 leaves
empty, and none is needed here. What mcap leaves to its caller is here: the checksums of the index
(summary) and of the data section, the number of messages, and to go on behind a damaged chunk,
which needs the place of the next one from the index, or a damaged chunk whose length is whole.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import sqlite3
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import IO, Any, TypeAlias

import yaml
import zstandard
from mcap import records
from mcap.reader import FOOTER_SIZE
from mcap.records import Chunk, ChunkIndex, McapRecord
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem, refusal

_DATA_END_SIZE = 9 + 4  # bytes of opcode and length, and of its content
_PIECE = 1 << 20

RawMessage: TypeAlias = tuple[str, str, int, bytes]
"""Topic, type, reception by the recorder [ns], serialized content."""


@dataclass(frozen=True)
class Topic:
    """A topic to look for: the last word of its name, which may be `anywhere`, its message type."""

    key: str
    type: str
    anywhere: bool = True

    @property
    def ending(self) -> str:
        """End of its full name, or the whole name where it is not `anywhere`."""
        return f"/{self.key}"

    def matches(self, name: str) -> bool:
        """Return whether a full name is that of this topic."""
        return name.endswith(self.ending) if self.anywhere else name == self.ending


class Bag:
    """A recording, MCAP or sqlite3, a folder or a single file; refused where there is none.

    Topics that are not requested are skipped. With `damaged`, what is intact of a damaged recording
    is read instead of refusing it. Attributes are complete when `messages` is exhausted.
    """

    def __init__(self, path: Path, requested: Sequence[Topic], *, damaged: bool = False) -> None:
        if not os.path.exists(path):  # noqa: PTH110  # Path's raises where a name is too long
            raise refusal(path, "bag", str(path), "does not exist")
        self.path = path
        self.topics: dict[str, str] = {}  # full names of the topics found, by key
        self.damage: tuple[str, ...] = ()  # what is damaged or lost, a line for each part
        self.unverified = 0  # chunks without a checksum
        self._requested, self._damaged = requested, damaged
        self._channels: dict[tuple[str, str], Topic | None] = {}

    def messages(self) -> Iterator[tuple[str, int, Any]]:
        """Yield key of the topic, reception [ns] and content of the messages, as the file has them.

        Raises InputError where the recording is damaged, which is known at the end at the latest,
        where it is empty, and where two topics match one that is requested.
        """
        store, empty = message_types(), True
        for name, message_type, received_ns, data in self._stored():
            empty = False
            if (topic := self._topic(name, message_type)) is None:
                continue
            try:
                content = store.deserialize_cdr(data, message_type)
            except Exception as error:  # rosbags raises anything on bad bytes
                raise self._not_whole(error, f" in {topic.key}") from None
            yield topic.key, received_ns, content
        if empty:
            raise refusal(self.path, "messages", 0, "the recording is empty")

    @property
    def absent(self) -> dict[str, Problem]:
        """Why a requested topic is missing, by its key."""
        found = {}
        for topic in (one for one in self._requested if one.key not in self.topics):
            others = [f"{name} ({kind})" for name, kind in self._channels if topic.matches(name)]
            allowed = f"no topic of type {topic.type} ends in {topic.ending}; record it"
            found[topic.key] = Problem(topic.key, ", ".join(sorted(others)) or None, allowed)
        return found

    def _stored(self) -> Iterator[RawMessage]:
        """Yield the messages of all files; of a database those of requested topics alone."""
        files, compressed = self._files()
        with tempfile.TemporaryDirectory() as folder:
            for path in files:
                try:
                    file = _decompress(path, Path(folder)) if compressed == "file" else path
                    stored = self._read_mcap if file.suffix == ".mcap" else self._read_database
                    for name, message_type, received_ns, data in stored(file):
                        if compressed == "message":
                            data = zstandard.ZstdDecompressor().decompressobj().decompress(data)
                        yield name, message_type, received_ns, data
                except (OSError, zstandard.ZstdError) as error:
                    raise self._not_whole(error) from None

    def _files(self) -> tuple[list[Path], str]:
        """Return the files in their order, and what of them is compressed: file, message or ""."""
        if not self.path.is_dir():
            return [self.path], ""
        files, compressed = [], ""
        try:
            text = (self.path / "metadata.yaml").read_text(encoding="utf-8")
            found = yaml.safe_load(text)["rosbag2_bagfile_information"]
            files = [self.path / PurePath(name).name for name in found["relative_file_paths"]]
            compressed = str(found.get("compression_mode") or "").lower()
        except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
            if not self._damaged:
                raise self._not_whole(f"metadata.yaml: {error}") from None
        if self._damaged and not (files and all(map(Path.exists, files))):
            files = sorted(self.path.glob("*.mcap"))
        return files, compressed

    def _read_mcap(self, path: Path) -> Iterator[RawMessage]:
        file = McapFile(path)
        yield from file.messages()
        for channel in file.channels.values():
            self._topic(*channel)
        lines = file.describe()
        if lines and not self._damaged:
            raise self._not_whole("; ".join(lines), advice=", --damaged reads it here")
        self.damage += tuple(lines)
        self.unverified += file.unverified

    def _read_database(self, path: Path) -> Iterator[RawMessage]:
        count = 0
        try:
            # Not written to, nor is a journal made beside it.
            address = f"{path.absolute().as_uri()}?immutable=1"
            with contextlib.closing(sqlite3.connect(address, uri=True)) as database:
                topics = database.execute("SELECT id, name, type FROM topics")
                chosen = {key: channel for key, *channel in topics if self._topic(*channel)}
                rows = "SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN "
                rows += f"({','.join('?' * len(chosen))}) ORDER BY timestamp"
                for key, received_ns, data in database.execute(rows, [*chosen]):
                    yield *chosen[key], int(received_ns), data
                    count += 1
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise self._not_whole(error, f" after {count} messages") from None

    def _topic(self, name: str, message_type: str) -> Topic | None:
        """Return the requested topic of a channel, and note that it was found."""
        channel = name, message_type
        if channel not in self._channels:
            named = (one for one in self._requested if one.matches(name))
            topic = next((one for one in named if one.type == message_type), None)
            self._channels[channel] = topic
            if topic is not None and self.topics.setdefault(topic.key, name) != name:
                names = ", ".join(sorted([self.topics[topic.key], name]))
                allowed = f"only one topic may end in {topic.ending}; record one simulator a bag"
                raise refusal(self.path, topic.key, names, allowed)
        return self._channels[channel]

    def _not_whole(self, reason: object, where: str = "", advice: str = "") -> InputError:
        sqlite = self.path.suffix == ".db3" or any(self.path.glob("*.db3"))
        by = "sqlite3 FILE .recover | sqlite3 NEW" if sqlite else "python -m sst_ros recover BAG"
        allowed = (
            "must be a whole rosbag2 recording, MCAP or sqlite3; "
            f"reading failed{where}: {_one_line(reason)}; "
            f"{by} makes a whole one of what is intact{advice}"
        )
        return refusal(self.path, "bag", self.path.name, allowed)


@dataclass
class Damage:
    """A part of a file that cannot be used; times that are not known are 0."""

    offset: int  # first byte of the part
    reason: str  # what is wrong with it
    begin_ns: int = 0  # first reception of its messages
    end_ns: int = 0  # last one


class McapFile:
    """Reads one MCAP file; the attributes are complete when `messages` is exhausted."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, tuple[str, str]] = {}  # topic and type by number
        self.damage: list[Damage] = []
        self.cut = False  # the file ends before its index does
        self.unverified = 0  # chunks without a checksum
        self.count = self.lost = 0  # messages that were read, and that are known to be lost
        self._origin_ns = 0

    def describe(self) -> list[str]:
        """Name what is damaged or lost, a line for each part; none of a whole file."""
        lines = []
        for one in self.damage:
            line = f"{self.path.name}, byte {one.offset}: {one.reason}"
            if one.end_ns:  # seconds after the first message
                first, last = ((ns - self._origin_ns) / 1e9 for ns in (one.begin_ns, one.end_ns))
                line += f" ({first:.3f} s to {last:.3f} s)"
            lines.append(line)
        if self.cut:
            lines.append(f"{self.path.name}: the file ends before its index")
        if self.lost:
            lines.append(f"{self.path.name}: {self.lost} messages are lost")
        return lines

    def messages(self) -> Iterator[RawMessage]:
        """Yield all messages that are intact, in the order of the file; may raise OSError."""
        schemas: dict[int, str] = {}
        with self.path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                self.damage.append(Damage(0, "the magic bytes of MCAP are missing"))
            index, data_end = self._read_index(file)
            chunks = [one for one in index if isinstance(one, ChunkIndex)]
            stored = self._read_at(file, chunks) if chunks else self._read_on(file)
            for record in itertools.chain(index, stored):
                if isinstance(record, records.Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, records.Channel):
                    self.channels[record.id] = record.topic, schemas.get(record.schema_id, "")
                elif isinstance(record, records.Message):
                    if channel := self.channels.get(record.channel_id):
                        self.count += 1
                        yield *channel, record.log_time, record.data
                    else:
                        reason = f"channel {record.channel_id} is not described"
                        self.damage.append(Damage(0, reason))
            if index and not self.damage:
                self._check_data(file, data_end)
        # Only an index whose checksum is right says how many there were.
        written = (one.message_count for one in index if isinstance(one, records.Statistics))
        self.lost = max(0, next(written, 0) - self.count)

    def _read_index(self, file: IO[bytes]) -> tuple[list[McapRecord], int]:
        """Return the records of the index and where it begins; none where it is not intact."""
        footer_at = file.seek(0, io.SEEK_END) - FOOTER_SIZE - len(MCAP0_MAGIC)
        file.seek(max(footer_at, 0))
        end = file.read()
        if footer_at < len(MCAP0_MAGIC) or end[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
            self.cut = True
            return [], 0
        try:
            footer = next(_records(end))
            if not isinstance(footer, records.Footer) or footer.summary_start > footer_at:
                raise ValueError("index with wrong position")
            begin = footer.summary_start or footer_at
            file.seek(begin)
            content = file.read()
            if footer.summary_crc not in (0, zlib.crc32(content[: -4 - len(MCAP0_MAGIC)])):
                raise ValueError("index with wrong checksum")
            index = list(_records(content))
            chunks = [one for one in index if isinstance(one, ChunkIndex)]
            if any(one.chunk_start_offset + one.chunk_length > begin for one in chunks):
                raise ValueError("index with wrong position")
            return index, begin
        except Exception as error:  # mcap raises anything on bad bytes
            self.damage.append(Damage(footer_at, _one_line(error)))
            return [], 0

    def _read_at(self, file: IO[bytes], chunks: Sequence[ChunkIndex]) -> Iterator[McapRecord]:
        """Yield the records in each chunk, where the index says that it begins."""
        for one in sorted(chunks, key=lambda one: one.chunk_start_offset):
            begin = file.seek(one.chunk_start_offset)
            stored = _records(file.read(one.chunk_length), chunks=True)
            place = Damage(begin, "", one.message_start_time, one.message_end_time)
            yield from self._open(stored, place)

    def _read_on(self, file: IO[bytes]) -> Iterator[McapRecord]:
        """Yield the records from the beginning to where they end, or to what is no record."""
        file.seek(len(MCAP0_MAGIC))
        stored = _records(file, chunks=True)
        while True:
            offset = file.tell()
            try:
                record = next(stored)
            except Exception:  # mcap raises anything on bad bytes
                break
            if isinstance(record, records.DataEnd):
                return
            if isinstance(record, Chunk):
                place = Damage(offset, "", record.message_start_time, record.message_end_time)
                yield from self._open(iter([record]), place)
            else:
                yield record
        if not self.cut:
            self.damage.append(Damage(offset, "unreadable bytes"))

    def _open(self, stored: Iterator[McapRecord], place: Damage) -> Sequence[McapRecord]:
        """Return the records in a chunk that comes next; none, and note it, if it is damaged."""
        self._origin_ns = self._origin_ns or place.begin_ns
        try:
            chunk = next(stored)
            if not isinstance(chunk, Chunk):
                raise ValueError("no chunk where the index has one")
            found = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:  # mcap raises anything on bad bytes
            wrong = isinstance(error, CRCValidationError)
            place.reason = "chunk with wrong checksum" if wrong else _one_line(error)
            self.damage.append(place)
            return ()
        self.unverified += not chunk.uncompressed_crc
        return found

    def _check_data(self, file: IO[bytes], end: int) -> None:
        """Check the data section, which ends at `end`: also what lies between its chunks."""
        begin, checksum, record = end - _DATA_END_SIZE, file.seek(0), None
        while piece := file.read(min(_PIECE, begin - file.tell())):
            checksum = zlib.crc32(piece, checksum)
        with contextlib.suppress(Exception):  # mcap raises anything on bad bytes
            record = next(_records(file))
        if not isinstance(record, records.DataEnd) or file.tell() != end:
            self.damage.append(Damage(begin, "the end of the data section is missing"))
        elif record.data_section_crc not in (0, checksum):
            self.damage.append(Damage(begin, "data section with wrong checksum"))


def _records(source: bytes | IO[bytes], *, chunks: bool = False) -> Iterator[McapRecord]:
    """Yield the records of a file from here on, or of bytes; chunks whole, or what is in them."""
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    return StreamReader(file, skip_magic=True, emit_chunks=chunks).records


@cache
def message_types() -> Any:
    """Return the message types of ROS 2 with their compiled (de)serializers."""
    return get_typestore(Stores.ROS2_KILTED)


def _decompress(path: Path, folder: Path) -> Path:
    """Write a file that is compressed as a whole into a folder, under the name that it had."""
    with path.open("rb") as source, (folder / path.stem).open("wb") as target:
        zstandard.ZstdDecompressor().copy_stream(source, target)
    return folder / path.stem


def _one_line(error: object) -> str:
    return " ".join(str(error).split()) or type(error).__name__
