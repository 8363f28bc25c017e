# SPDX-License-Identifier: Apache-2.0
"""The messages of a rosbag2 recording in one pass.

Every fault of it becomes an InputError.

mcap reads MCAP and checks each chunk by its CRC-32; rosbags knows the types of the
messages. A database is read as such: rosbags refuses one with an action, whose
definitions rosbag2 leaves empty, and none is needed here. What mcap leaves to its
caller is here: the checksums of the index (summary) and of the data section, messages
outside of chunks, the number of messages, and to go on behind a damaged chunk, which
needs the place of the next one from the index, or a damaged chunk whose length is
whole.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
import shutil
import sqlite3
import struct
import tempfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import IO, Any, NamedTuple, TypeAlias

import zstandard
from mcap import records
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Chunk, ChunkIndex, McapRecord
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, refusal
from sst_ros.scene.yaml_document import read_file, read_values
from sst_ros.state import NANOSECONDS

_HEAD = struct.Struct("<BQ")  # opcode and length, with which each record of MCAP begins
_CHECKSUM_SIZE = 4  # bytes of a CRC-32
_DATA_END_SIZE = _HEAD.size + _CHECKSUM_SIZE  # bytes of the record behind the data
_PIECE = 1 << 20  # bytes read at once to check a file, which may exceed the memory
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SQLITE_MAGIC = b"SQLite format 3\0"
_UNFINISHED = ("-wal", "-journal")
"""Files beside a database in which SQLite keeps what a killed process had not yet moved
into it, or out of it."""
_STORED = re.compile(
    r"(?P<recording>.*?)(?:_(?P<number>\d+))?\.(?P<storage>mcap|db3)(?:\.zstd)?"
)
"""Name of a file of a recording: what all of them share, its number, what it is."""

SIMULATOR_NODE = "simulator"
NAMESPACE = "namespace"
CONTROLLER_NODE = "controller"
EVERYBODY = "everybody"

RawMessage: TypeAlias = tuple[str, str, int, bytes]
"""Topic, type, reception by the recorder [ns], serialized content."""


@dataclass(frozen=True)
class Topic:
    """A topic of a run: the last part of its name, its message type, and whose it is.

    The owner is SIMULATOR_NODE for a topic of the simulator's node, NAMESPACE for one
    that lies beside the node, CONTROLLER_NODE for one of another node there, EVERYBODY
    for one whose name is the same for all.
    """

    key: str
    type: str
    owner: str = SIMULATOR_NODE

    @property
    def ending(self) -> str:
        """End of its full name, the whole name where it is everybody's."""
        return f"/{self.key}"

    def may_be(self, name: str) -> bool:
        """Return whether some run may have it by this full name."""
        if self.owner == EVERYBODY:
            return name == self.ending
        return name.endswith(self.ending)


class Received(NamedTuple):
    """A message of a topic that some run may have."""

    name: str  # full name of the topic
    topic: Topic
    received_ns: int  # by the recorder's clock
    content: Any


class Bag:
    """A recording, MCAP or sqlite3, a folder or a single file.

    Refused where there is none.

    Topics that are not requested are skipped. With `damaged`, what is intact of a
    damaged recording is read instead of refusing it. Attributes are complete when
    `messages` is exhausted, `topics` when they have been selected.
    """

    def __init__(
        self, path: Path, requested: Sequence[Topic], *, damaged: bool = False
    ) -> None:
        if not os.path.exists(path):  # noqa: PTH110  # Path's raises where a name is too long
            raise refusal(path, "bag", str(path), "does not exist")
        if not (path.is_dir() or path.is_file()):
            raise refusal(path, "bag", str(path), "must be a folder or a file")
        self.path = path
        self.channels: dict[str, str] = {}  # type of each topic of the recording
        # what they may be of a run, by full name
        self.candidates: dict[str, Topic] = {}
        self.topics: dict[str, str] = {}  # full names of the topics of the run, by key
        # what is damaged or lost, a line for each part
        self.damage: tuple[str, ...] = ()
        self.unverified = 0  # chunks without a checksum
        self._requested = requested
        self._damaged = damaged
        self._empty = True  # no database has a message, of whatever topic
        self._unreadable: dict[str, InputError] = {}

    def messages(self) -> Iterator[Received]:
        """Yield the messages of topics that some run may have, as the file has them.

        Raises InputError where the recording is damaged, which is known at the end at
        the latest, and where it is empty.
        """
        store = message_types()
        for name, message_type, received_ns, data in self._stored():
            topic = self._candidate(name, message_type)
            if topic is None or name in self._unreadable:
                continue
            try:
                content = store.deserialize_cdr(data, message_type)
            except Exception as error:  # rosbags raises anything on bad bytes
                self._unreadable[name] = self._not_whole(error, f" in {name}")
                continue
            yield Received(name, topic, received_ns, content)

    def select(self, names: Mapping[str, str]) -> None:
        """Take topics for the run, full names by their keys.

        Raises InputError where a message of one of them could not be read.
        """
        self.topics = dict(names)
        for name in names.values():
            if name in self._unreadable:
                raise self._unreadable[name]

    def _stored(self) -> Iterator[RawMessage]:
        """Yield the messages of all files.

        Of a database those of requested topics alone.
        """
        files, declared = self._files()
        counts = Counter[str]()
        with tempfile.TemporaryDirectory() as folder:
            for path in files:
                try:
                    file, storage = _prepare(path, Path(folder))
                    read = self._read_mcap if storage == "mcap" else self._read_database
                    for name, message_type, received_ns, data in read(
                        file, Path(folder)
                    ):
                        if data[: len(_ZSTD_MAGIC)] == _ZSTD_MAGIC:
                            data = _decompress_message(data)
                        counts[name] += 1
                        yield name, message_type, received_ns, data
                except (OSError, zstandard.ZstdError) as error:
                    raise self._not_whole(error) from None
        self._compare_counts(declared, counts)
        if self._empty and not counts:
            raise refusal(self.path, "messages", 0, "the recording is empty")

    def _compare_counts(
        self, declared: Mapping[str, int], counts: Counter[str]
    ) -> None:
        """Note where the recording has other numbers of messages than it says."""
        lines = [
            f"{name}: {counts[name]} messages of {number} that metadata.yaml counts"
            for name, number in declared.items()
            if name in self.candidates and counts[name] != number
        ]
        if lines and not self._damaged:
            raise self._not_whole("; ".join(lines), advice=_READ_DAMAGED)
        self.damage += tuple(lines)

    def _files(self) -> tuple[list[Path], dict[str, int]]:
        """Return the files in their order, and their numbers of messages.

        The numbers are by topic. Without metadata.yaml, which a killed recorder has not
        written, the files are those that are there, and nothing says how much they
        hold.
        """
        if not self.path.is_dir():
            return [self.path], {}
        files = list[Path]()
        counts = dict[str, int]()
        metadata_path = self.path / "metadata.yaml"
        try:
            metadata = read_values(read_file(metadata_path), "metadata.yaml")
            metadata = metadata["rosbag2_bagfile_information"]
            files = [
                self.path / PurePath(name).name
                for name in metadata["relative_file_paths"]
            ]
            for counted in metadata.get("topics_with_message_count") or ():
                name = str(counted["topic_metadata"]["name"])
                counts[name] = counts.get(name, 0) + int(counted["message_count"])
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            InputError,
        ) as error:
            if not self._damaged and (metadata_path.exists() or not self._list_files()):
                reason = str(error).removeprefix("metadata.yaml: ")
                raise self._not_whole(f"metadata.yaml: {reason}") from None
        are_there = bool(files) and all(map(Path.exists, files))
        if not are_there and (self._damaged or not files):
            files = self._list_files()
        return files, counts

    def _list_files(self) -> list[Path]:
        """List the files of one recording in the folder.

        They are in the order of their numbers.
        """
        matches = list[tuple[re.Match[str], Path]]()
        for path in self.path.iterdir():
            match = _split_name(path)
            if match is not None:
                matches.append((match, path))
        recordings = {(match["recording"], match["storage"]) for match, _ in matches}
        if len(recordings) > 1:
            names = ", ".join(sorted(path.name for _, path in matches))
            requirement = (
                "are files of several recordings, without metadata.yaml: name one file"
            )
            raise refusal(self.path, "bag", names, requirement)
        matches.sort(key=lambda pair: int(pair[0]["number"] or 0))
        return [path for _, path in matches]

    def _read_mcap(self, path: Path, _: Path) -> Iterator[RawMessage]:
        file = McapFile(path)
        yield from file.messages()
        for channel in file.channels.values():
            self._candidate(*channel)
        lines = file.describe()
        if lines and not self._damaged:
            raise self._not_whole("; ".join(lines), advice=_READ_DAMAGED)
        self.damage += tuple(lines)
        self.unverified += file.unverified

    def _read_database(self, path: Path, folder: Path) -> Iterator[RawMessage]:
        """Yield the messages of requested topics in a database.

        They are read with all that SQLite sees.
        """
        count = 0
        beside = [path.with_name(path.name + ending) for ending in _UNFINISHED]
        unfinished = [file for file in beside if file.exists() and file.stat().st_size]
        try:
            # Not written to, nor is a journal made beside it.
            address = f"{path.absolute().as_uri()}?immutable=1"
            if not unfinished:
                _check_pages(path)
            else:  # SQLite brings a copy to its last whole state
                own = folder / "unfinished"
                own.mkdir(exist_ok=True)
                for file in (path, *unfinished):
                    shutil.copyfile(file, own / file.name)
                address = (own / path.name).absolute().as_uri()
            with contextlib.closing(sqlite3.connect(address, uri=True)) as database:
                topics = database.execute("SELECT id, name, type FROM topics")
                chosen: dict[Any, tuple[str, str]] = {}
                for topic_id, name, message_type in topics:
                    if self._candidate(name, message_type) is not None:
                        chosen[topic_id] = (name, message_type)
                query = (
                    "SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN "
                )
                query += f"({','.join('?' * len(chosen))}) ORDER BY timestamp"
                for topic_id, received_ns, data in database.execute(query, [*chosen]):
                    yield *chosen[topic_id], int(received_ns), data
                    count += 1
                any_message = "SELECT EXISTS (SELECT 1 FROM messages)"
                (has_messages,) = database.execute(any_message).fetchone()
                self._empty = self._empty and not has_messages
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise self._not_whole(error, f" after {count} messages") from None

    def _candidate(self, name: str, message_type: str) -> Topic | None:
        """Return what a topic may be of a run, and note the topic."""
        if self.channels.setdefault(name, message_type) != message_type:
            return None  # of two types: that which comes first
        if name not in self.candidates:
            for topic in self._requested:
                if topic.type == message_type and topic.may_be(name):
                    self.candidates[name] = topic
        return self.candidates.get(name)

    def _not_whole(
        self, reason: object, where: str = "", advice: str = ""
    ) -> InputError:
        sqlite = ".db3" in self.path.suffixes or any(self.path.glob("*.db3*"))
        command = "python -m sst_ros recover BAG"
        if sqlite:
            command = "sqlite3 FILE .recover | sqlite3 NEW"
        requirement = (
            "must be a whole rosbag2 recording, MCAP or sqlite3; "
            f"reading failed{where}: {_one_line(reason)}; "
            f"{command} makes a whole one of what is intact{advice}"
        )
        return refusal(self.path, "bag", self.path.name, requirement)


_READ_DAMAGED = ", --damaged reads it here"


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
        self.count = 0  # messages that were read
        self.lost = 0  # messages that are known to be lost
        self._origin_ns = 0
        self._schemas: dict[int, str] = {}

    def describe(self) -> list[str]:
        """Name what is damaged or lost, a line for each part; none of a whole file."""
        lines = []
        for damage in self.damage:
            line = f"{self.path.name}, byte {damage.offset}: {damage.reason}"
            if damage.end_ns:  # seconds after the first message
                first = (damage.begin_ns - self._origin_ns) / NANOSECONDS
                last = (damage.end_ns - self._origin_ns) / NANOSECONDS
                line += f" ({first:.3f} s to {last:.3f} s)"
            lines.append(line)
        if self.cut:
            lines.append(f"{self.path.name}: the file ends before its index")
        if self.lost:
            lines.append(f"{self.path.name}: {self.lost} messages are lost")
        return lines

    def messages(self) -> Iterator[RawMessage]:
        """Yield all messages that are intact, those outside of chunks last.

        May raise OSError.
        """
        with self.path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                self.damage.append(Damage(0, "the magic bytes of MCAP are missing"))
            index, data_end = self._read_index(file)
            chunks = [entry for entry in index if isinstance(entry, ChunkIndex)]
            chunks.sort(key=lambda entry: entry.chunk_start_offset)
            # Only an index whose checksum is right says how many there were.
            written = [
                entry for entry in index if isinstance(entry, records.Statistics)
            ]
            if not chunks:
                yield from self._take(itertools.chain(index, self._read_on(file)))
            else:
                outside = list(_gaps(chunks, data_end))
                described = self._read_gaps(file, outside, _DESCRIPTIONS)
                yield from self._take(itertools.chain(index, described))
                yield from self._take(self._read_at(file, chunks))
            if index and not self.damage:
                self._check_data(file, data_end)
                sound = not self.damage
            else:
                sound = bool(index)
            is_whole = written and self.count >= written[0].message_count
            if chunks and sound and not is_whole:
                yield from self._take(self._read_gaps(file, outside, _MESSAGES))
        if written:
            self.lost = max(0, written[0].message_count - self.count)

    def _take(self, stored: Iterator[McapRecord]) -> Iterator[RawMessage]:
        """Yield the messages of records, and keep the descriptions that come first."""
        for record in stored:
            if isinstance(record, records.Schema):
                self._schemas.setdefault(record.id, record.name)
            elif isinstance(record, records.Channel):
                described = record.topic, self._schemas.get(record.schema_id, "")
                self.channels.setdefault(record.id, described)
            elif isinstance(record, records.Message):
                if channel := self.channels.get(record.channel_id):
                    self.count += 1
                    yield *channel, record.log_time, record.data
                else:
                    reason = f"channel {record.channel_id} is not described"
                    self.damage.append(Damage(0, reason))

    def _read_gaps(
        self, file: IO[bytes], gaps: Sequence[tuple[int, int]], opcodes: Collection[int]
    ) -> Iterator[McapRecord]:
        """Yield the records of some kinds that lie between chunks.

        Most recordings have none there.
        """
        for begin, end in gaps:
            place = begin
            while place < end:
                file.seek(place)
                opcode, length = _HEAD.unpack(file.read(_HEAD.size))
                behind = place + _HEAD.size + length
                if behind > end:
                    damage = Damage(place, "unreadable bytes between chunks")
                    if damage not in self.damage:  # both kinds of records look here
                        self.damage.append(damage)
                    break
                if opcode in opcodes:
                    file.seek(place)
                    yield from self._parse(file.read(behind - place), place)
                place = behind

    def _parse(self, content: bytes, place: int) -> Sequence[McapRecord]:
        """Return the record in some bytes; note them, without one, if damaged."""
        try:
            return [next(_records(content))]
        except Exception as error:  # mcap raises anything on bad bytes
            self.damage.append(Damage(place, _one_line(error)))
            return ()

    def _read_index(self, file: IO[bytes]) -> tuple[list[McapRecord], int]:
        """Return the records of the index and where it begins.

        Where it is not intact there are no records, and zero.
        """
        footer_at = file.seek(0, io.SEEK_END) - FOOTER_SIZE - len(MCAP0_MAGIC)
        file.seek(max(footer_at, 0))
        end = file.read()
        if footer_at < len(MCAP0_MAGIC) or end[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC:
            self.cut = True
            return [], 0
        try:
            footer = next(_records(end))
            if (
                not isinstance(footer, records.Footer)
                or footer.summary_start > footer_at
            ):
                raise ValueError("index with wrong position")
            begin = footer.summary_start or footer_at
            file.seek(begin)
            content = file.read()
            # The checksum is the last field of the footer, which is the last record.
            checked = content[: -_CHECKSUM_SIZE - len(MCAP0_MAGIC)]
            if footer.summary_crc not in (0, zlib.crc32(checked)):  # 0: it has none
                raise ValueError("index with wrong checksum")
            index = list(_records(content))
            for chunk in index:
                if not isinstance(chunk, ChunkIndex):
                    continue
                if chunk.chunk_start_offset + chunk.chunk_length > begin:
                    raise ValueError("index with wrong position")
            return index, begin
        except Exception as error:  # mcap raises anything on bad bytes
            self.damage.append(Damage(footer_at, _one_line(error)))
            return [], 0

    def _read_at(
        self, file: IO[bytes], chunks: Sequence[ChunkIndex]
    ) -> Iterator[McapRecord]:
        """Yield the records in each chunk, where the index says that it begins."""
        for chunk in chunks:
            begin = file.seek(chunk.chunk_start_offset)
            stored = _records(file.read(chunk.chunk_length), chunks=True)
            place = Damage(begin, "", chunk.message_start_time, chunk.message_end_time)
            yield from self._open(stored, place)

    def _read_on(self, file: IO[bytes]) -> Iterator[McapRecord]:
        """Yield the records from the beginning to where they end.

        They also end at what is no record.
        """
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
                place = Damage(
                    offset, "", record.message_start_time, record.message_end_time
                )
                yield from self._open(iter([record]), place)
            else:
                yield record
        if not self.cut:
            self.damage.append(Damage(offset, "unreadable bytes"))

    def _open(
        self, stored: Iterator[McapRecord], place: Damage
    ) -> Sequence[McapRecord]:
        """Return the records in a chunk that comes next.

        If it is damaged there are none, and the damage is noted.
        """
        self._origin_ns = self._origin_ns or place.begin_ns
        try:
            chunk = next(stored)
            if not isinstance(chunk, Chunk):
                raise ValueError("no chunk where the index has one")
            opened = breakup_chunk(chunk, validate_crc=True)
        except Exception as error:  # mcap raises anything on bad bytes
            wrong = isinstance(error, CRCValidationError)
            place.reason = "chunk with wrong checksum" if wrong else _one_line(error)
            self.damage.append(place)
            return ()
        if not chunk.uncompressed_crc:
            self.unverified += 1
        return opened

    def _check_data(self, file: IO[bytes], end: int) -> None:
        """Check the data section, which ends at `end`.

        What lies between its chunks is checked, too.
        """
        begin = end - _DATA_END_SIZE
        checksum = 0
        record = None
        file.seek(0)
        while block := file.read(min(_PIECE, begin - file.tell())):
            checksum = zlib.crc32(block, checksum)
        with contextlib.suppress(Exception):  # mcap raises anything on bad bytes
            record = next(_records(file))
        if not isinstance(record, records.DataEnd) or file.tell() != end:
            self.damage.append(Damage(begin, "the end of the data section is missing"))
        elif record.data_section_crc not in (0, checksum):  # 0: it has none
            self.damage.append(Damage(begin, "data section with wrong checksum"))


def _records(
    source: bytes | IO[bytes], *, chunks: bool = False
) -> Iterator[McapRecord]:
    """Yield the records of a file from here on, or of bytes.

    Chunks whole, or what is in them.
    """
    file = io.BytesIO(source) if isinstance(source, bytes) else source
    return StreamReader(file, skip_magic=True, emit_chunks=chunks).records


@cache
def message_types() -> Any:
    """Return the message types of ROS 2 with their compiled (de)serializers."""
    return get_typestore(Stores.ROS2_KILTED)


_DESCRIPTIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_MESSAGES = (Opcode.MESSAGE,)


def _gaps(chunks: Sequence[ChunkIndex], end: int) -> Iterator[tuple[int, int]]:
    """Yield where the parts between the chunks begin and end.

    These are the parts of the data section that are no chunk or its index.
    """
    begin = len(MCAP0_MAGIC)
    for chunk in chunks:
        yield begin, chunk.chunk_start_offset
        begin = (
            chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
        )
    yield begin, end - _DATA_END_SIZE


def _split_name(path: Path) -> re.Match[str] | None:
    """Return the parts of the name of a file of a recording; None for another file."""
    return _STORED.fullmatch(path.name)


def _prepare(path: Path, folder: Path) -> tuple[Path, str]:
    """Return a file, decompressed into the folder where it must be, and what it is.

    Its first bytes say what it is, its name only where they say nothing.
    """
    if _magic(path) == _ZSTD_MAGIC:
        target = folder / path.name.removesuffix(".zstd")
        with path.open("rb") as source, target.open("wb") as decompressed:
            zstandard.ZstdDecompressor().copy_stream(source, decompressed)
        path = target
    with path.open("rb") as file:
        begin = file.read(len(_SQLITE_MAGIC))
    if begin.startswith(MCAP0_MAGIC):
        return path, "mcap"
    named = _split_name(path)
    is_database = begin == _SQLITE_MAGIC or (named and named["storage"] == "db3")
    return path, "db3" if is_database else "mcap"


# Magic, bytes of a page, changes of the file, pages, changes when these were counted.
_SQLITE_HEADER = struct.Struct(">16sH6x4sL60x4s4x")
_LARGEST_PAGE = 65536  # which the header writes as 1


def _check_pages(path: Path) -> None:
    """Check that a database has as many pages as its header says.

    SQLite 3.53 does not do so where it opens a file as immutable. A header without a
    valid number of pages is not checked (SQLite's file format, 1.3).

    Raises:
        ValueError: the file is shorter.

    """
    with path.open("rb") as file:
        header = file.read(_SQLITE_HEADER.size)
    if len(header) < _SQLITE_HEADER.size:
        return
    magic, page_bytes, changes, pages, counted_at = _SQLITE_HEADER.unpack(header)
    if page_bytes == 1:
        page_bytes = _LARGEST_PAGE
    is_counted = magic == _SQLITE_MAGIC and changes == counted_at
    expected_bytes = pages * page_bytes
    file_bytes = path.stat().st_size
    if is_counted and file_bytes < expected_bytes:
        raise ValueError(f"the file has {file_bytes} of {expected_bytes} bytes")


def _magic(path: Path) -> bytes:
    """Return the first four bytes of a file."""
    with path.open("rb") as file:
        return file.read(len(_ZSTD_MAGIC))


def _decompress_message(data: bytes) -> bytes:
    """Return the content of a message that was compressed by itself."""
    return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(data))


def _one_line(error: object) -> str:
    return " ".join(str(error).split()) or type(error).__name__
