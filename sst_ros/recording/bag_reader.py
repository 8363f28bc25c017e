# SPDX-License-Identifier: Apache-2.0
"""The messages of a rosbag2 recording in one pass; every fault of it becomes an InputError."""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path, PurePath
from struct import Struct
from struct import error as StructError
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, MessageIndex, Schema, Statistics
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem

RECORD, MESSAGE = Struct("<BQ"), Struct("<HIQQ")
ERRORS = (
    McapError, StructError, ValueError, KeyError, EOFError, RuntimeError, MemoryError,
    zstandard.ZstdError,
)  # fmt: skip
"""What reading a damaged record may raise."""

_DATA_OPCODES = frozenset({*range(Opcode.HEADER, Opcode.DATA_END + 1), *range(0x80, 0x100)})
_SMALLEST_CHUNK = 49
_DECOMPRESS: dict[str, Callable[[bytes], bytes]] = {
    "": lambda content: content,
    "zstd": lambda content: bytes(zstandard.ZstdDecompressor().decompressobj().decompress(content)),
    "lz4": lambda content: bytes(lz4.frame.decompress(content)),
}


@dataclass
class Damage:
    """A part of a file that cannot be used.

    Attributes:
        offset: first byte of the part.
        reason: what is wrong with it.
        messages: number of messages in it, 0 where that is not known.
        begin_ns, end_ns: first and last reception of them [ns], 0 where that is not known.

    """

    offset: int
    reason: str
    messages: int = 0
    begin_ns: int = 0
    end_ns: int = 0

    def add(self, index: MessageIndex) -> None:
        """Count the messages that the index of a chunk lists for one channel."""
        times = [time for time, _ in index.records]
        if times:
            self.begin_ns = min([self.begin_ns or times[0], *times])
            self.end_ns = max([self.end_ns, *times])
            self.messages += len(times)

    def describe(self, origin_ns: int) -> str:
        """Name offset, reason and time range, in seconds after `origin_ns`."""
        text = f"byte {self.offset}: {self.reason}"
        if self.messages:
            first, last = ((time - origin_ns) / 1e9 for time in (self.begin_ns, self.end_ns))
            text += f" ({self.messages} messages, {first:.3f} s to {last:.3f} s)"
        return text


def frame(data: mmap.mmap | bytes, position: int, end: int) -> tuple[int, int]:
    """Return opcode and end of the record at a position; the end is 0 where there is none."""
    if position + RECORD.size > end:
        return 0, 0
    opcode, length = RECORD.unpack_from(data, position)
    stop = position + RECORD.size + int(length)
    return (opcode, stop) if opcode in _DATA_OPCODES and stop <= end else (opcode, 0)


def records_of(chunk: Chunk) -> bytes:
    """Return the records of a chunk, decompressed.

    Raises:
        ERRORS: they cannot be decompressed, or size or checksum are wrong.

    """
    records = _DECOMPRESS[chunk.compression](chunk.data)
    if len(records) != chunk.uncompressed_size:
        raise ValueError("chunk of wrong size")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise ValueError("chunk with wrong checksum")
    return records


def next_chunk(data: mmap.mmap, position: int, end: int) -> int:
    """Find the next chunk that is intact and not empty; 0 where there is none."""
    while (position := data.find(bytes([Opcode.CHUNK]), position + 1, end)) > 0:
        _, stop = frame(data, position, end)
        if stop > position + _SMALLEST_CHUNK:
            try:
                if records_of(Chunk.read(stream(data[position + RECORD.size : stop]))):
                    return position
            except ERRORS:
                continue
    return 0


def stream(content: bytes) -> ReadDataStream:
    """Return content as a stream, which the records of `mcap` are read from."""
    return ReadDataStream(BytesIO(content))


def reason(error: Exception) -> str:
    """Describe an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "sst_ros"
"""Name of the writer in files of ours, whose messages are numbered from 1 on in each channel."""

_BODY = RECORD.size + MESSAGE.size
_FOOTER_SIZE = RECORD.size + 20


class McapMessage(NamedTuple):
    """One message: topic, type, reception by the recorder [ns], serialized content."""

    topic: str
    type: str
    received_ns: int
    data: bytes


class McapFile:
    """Reads one file; the attributes are complete when `messages` is exhausted.

    Args:
        path: the file.

    Attributes:
        channels: topic and type by number.
        damage: what cannot be used.
        cut: the file ends before its index does.
        unverified: number of chunks without a checksum.
        count: number of messages read.
        lost: number of messages known to be lost.

    Raises:
        OSError: the file cannot be read.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, tuple[str, str]] = {}
        self.damage: list[Damage] = []
        self.cut = False
        self.unverified = self.count = self.lost = 0
        self._schemas: dict[int, str] = {}
        self._origin_ns = 0
        self._expected: int | None = None
        self._numbered = False
        self._sequence: dict[int, int] = {}
        self._skipped = 0

    @property
    def intact(self) -> bool:
        """Whether the file is whole and all its checksums are right."""
        return not (self.cut or self.damage or self.lost)

    def describe(self) -> list[str]:
        """Name what is damaged or lost, a line for each part."""
        lines = [f"{self.path.name}, {one.describe(self._origin_ns)}" for one in self.damage]
        if self.cut:
            lines.append(f"{self.path.name}: the file ends before its index")
        if self.lost:
            lines.append(f"{self.path.name}: {self.lost} messages are lost")
        return lines

    def messages(self) -> Iterator[McapMessage]:
        """Yield all messages that are intact, in the order of the file."""
        if not self.path.stat().st_size:
            self.cut = True
            return
        with (
            self.path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            end = self._read_summary(data)
            yield from self._data_section(data, end)
        by_index = sum(one.messages for one in self.damage)
        by_statistics = 0 if self._expected is None else self._expected - self.count
        self.lost = max(by_index, by_statistics, self._skipped)

    def _data_section(self, data: mmap.mmap, end: int) -> Iterator[McapMessage]:
        """Yield the messages between the magic bytes and `end`."""
        position, checksum = len(MAGIC), zlib.crc32(MAGIC)
        broken: Damage | None = None
        if data[: len(MAGIC)] != MAGIC:
            self.damage.append(Damage(0, "the magic bytes of MCAP are missing"))
        while position < end:
            opcode, stop = frame(data, position, end)
            if not stop:
                resumed = next_chunk(data, position, end)
                if not resumed and self.cut:
                    yield from self._cut_chunk(data, position)
                    return
                self.damage.append(Damage(position, "unreadable bytes"))
                if not resumed:
                    return
                broken, position = self.damage[-1], resumed
                continue
            content = data[position + RECORD.size : stop]
            if opcode == Opcode.DATA_END:
                self._check_data_end(content, checksum, position)
                return
            checksum = zlib.crc32(data[position:stop], checksum)
            try:
                if opcode == Opcode.CHUNK:
                    broken = None
                    yield from self._records(self._verified(content))
                elif opcode == Opcode.MESSAGE_INDEX:
                    if broken:
                        broken.add(MessageIndex.read(stream(content)))
                else:
                    yield from self._records(data[position:stop])
            except ERRORS as error:
                broken = Damage(position, reason(error))
                self.damage.append(broken)
            position = stop
        if not self.cut:
            self.damage.append(Damage(position, "the end of the data section is missing"))

    def _verified(self, content: bytes) -> bytes:
        """Return the records of a chunk; counts it if it has no checksum."""
        chunk = Chunk.read(stream(content))
        self._origin_ns = self._origin_ns or chunk.message_start_time
        records = records_of(chunk)
        self.unverified += not chunk.uncompressed_crc
        return records

    def _records(self, records: bytes) -> Iterator[McapMessage]:
        """Yield the messages among records; schemas and channels are remembered."""
        position, end = 0, len(records)
        while position + RECORD.size <= end:
            opcode, length = RECORD.unpack_from(records, position)
            begin, stop = position, position + RECORD.size + length
            position = stop
            if stop > end:
                raise ValueError("record longer than its chunk")
            if opcode == Opcode.MESSAGE:
                number, sequence, received_ns, _ = MESSAGE.unpack_from(records, begin + RECORD.size)
                channel = self.channels.get(number)
                self._follow(number, sequence)
                if channel is None:
                    self.damage.append(Damage(0, f"channel {number} is not described", 1))
                    continue
                self.count += 1
                yield McapMessage(*channel, received_ns, records[begin + _BODY : stop])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.HEADER):
                self._describe(opcode, records[begin + RECORD.size : stop])

    def _describe(self, opcode: int, content: bytes) -> None:
        fields = stream(content)
        if opcode == Opcode.HEADER:
            self._numbered = Header.read(fields).library.startswith(LIBRARY)
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(fields)
            self._schemas[schema.id] = schema.name
        else:
            channel = Channel.read(fields)
            self.channels[channel.id] = (channel.topic, self._schemas.get(channel.schema_id, ""))

    def _follow(self, number: int, sequence: int) -> None:
        """Count the messages that are missing between those of one channel."""
        if self._numbered:
            self._skipped += max(0, sequence - self._sequence.get(number, 0) - 1)
            self._sequence[number] = sequence

    def _cut_chunk(self, data: mmap.mmap, position: int) -> Iterator[McapMessage]:
        """Yield the whole messages of an uncompressed chunk that the file ends in."""
        content = data[position : len(data)]
        if len(content) > RECORD.size and content[0] == Opcode.CHUNK:
            head = RECORD.size + 28
            if len(content) >= head + 12 and content[head : head + 4] == bytes(4):
                position += head + 12
                content = content[head + 12 :]
        end, complete = len(content), 0
        while True:
            opcode, stop = frame(content, complete, end)
            if not stop or opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                break
            complete = stop
        try:
            yield from self._records(content[:complete])
        except ERRORS as error:
            self.damage.append(Damage(position, reason(error)))

    def _check_data_end(self, content: bytes, checksum: int, position: int) -> None:
        expected = int.from_bytes(content, "little")
        if len(content) != 4 or (expected and expected != checksum and not self.damage):
            self.damage.append(Damage(position, "data section with wrong checksum"))

    def _read_summary(self, data: mmap.mmap) -> int:
        """Read channels and statistics from the index; return where the data section may end."""
        size = len(data)
        footer_at = size - len(MAGIC) - _FOOTER_SIZE
        if data[size - len(MAGIC) :] != MAGIC or footer_at < len(MAGIC):
            self.cut = True
            return size
        try:
            opcode, length = RECORD.unpack_from(data, footer_at)
            footer = Footer.read(stream(data[footer_at + RECORD.size : size - len(MAGIC)]))
            begin = footer.summary_start or footer_at
            if (opcode, length) != (Opcode.FOOTER, 20) or not len(MAGIC) <= begin <= footer_at:
                raise ValueError("index with wrong position")
            if footer.summary_crc and footer.summary_crc != zlib.crc32(data[begin : size - 12]):
                raise ValueError("index with wrong checksum")
            position = begin
            while position < footer_at:
                opcode, stop = frame(data, position, footer_at)
                if not stop:
                    raise ValueError("index with unreadable bytes")
                content = data[position + RECORD.size : stop]
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._describe(opcode, content)
                elif opcode == Opcode.STATISTICS:
                    self._expected = Statistics.read(stream(content)).message_count
                position = stop
        except ERRORS as error:
            self.damage.append(Damage(footer_at, reason(error)))
            return size
        return begin


class Topic(NamedTuple):
    """A topic to look for.

    Attributes:
        key: short name.
        ending: end of its full name, or the whole name where `anywhere` is False.
        type: message type.
        anywhere: any namespace and node name may precede the ending.

    """

    key: str
    ending: str
    type: str
    anywhere: bool = True

    def matches(self, name: str) -> bool:
        """Return whether a full name is that of this topic."""
        return name.endswith(self.ending) if self.anywhere else name == self.ending


class Message(NamedTuple):
    """One message: the key of its topic, reception by the recorder [ns], content."""

    key: str
    received_ns: int
    content: Any


class Bag:
    """A recording: MCAP or sqlite3, a folder or a single file.

    Args:
        path: of the recording.
        wanted: topics to read; all others are skipped.
        damaged: read what is intact of a damaged recording instead of refusing it.

    Attributes:
        topics: full names of the topics found, by key; complete when `messages` is exhausted.
        damage: what is damaged or lost, a line for each part.
        unverified: number of chunks without a checksum.

    Raises:
        InputError: there is no recording at the path.

    """

    def __init__(self, path: Path, wanted: Sequence[Topic], *, damaged: bool = False) -> None:
        if not path.exists():
            raise refused(path, "bag", str(path), "does not exist")
        self.path = path
        self.topics: dict[str, str] = {}
        self.damage: tuple[str, ...] = ()
        self.unverified = 0
        self._wanted, self._damaged = wanted, damaged
        self._store = message_types()
        self._channels: dict[tuple[str, str], Topic | None] = {}

    def messages(self) -> Iterator[Message]:
        """Yield the messages of the wanted topics, deserialized, in the order of the file.

        Raises:
            InputError: the recording is damaged, which is known at the end at the latest; it is
                empty; or two topics match one that is wanted.

        """
        count = 0
        files = self._mcap_files()
        source = self._read_mcap(files) if files else self._read_by_rosbags()
        for name, message_type, received_ns, data in source:
            count += 1
            topic = self._topic(name, message_type)
            if topic is None:
                continue
            try:
                content = self._store.deserialize_cdr(data, message_type)
            except Exception as error:  # rosbags raises anything on bad bytes
                raise self._not_whole(error, f" in {topic.key}") from None
            yield Message(topic.key, received_ns, content)
        if not count:
            raise refused(self.path, "messages", 0, "the recording is empty")

    def absence(self, topic: Topic) -> Problem:
        """Describe that a topic is missing."""
        others = [f"{name} ({kind})" for name, kind in self._channels if topic.matches(name)]
        allowed = f"no topic of type {topic.type} ends in {topic.ending}; record it"
        return Problem(topic.key, ", ".join(sorted(others)) or None, allowed)

    def _read_mcap(self, paths: Sequence[Path]) -> Iterator[McapMessage]:
        files = [McapFile(path) for path in paths]
        for file in files:
            try:
                yield from file.messages()
            except OSError as error:
                raise self._not_whole(error) from None
            for channel in file.channels.values():
                self._topic(*channel)
            if not file.intact and not self._damaged:
                raise self._not_whole("; ".join(file.describe()), advice=True)
        self.damage = tuple(line for file in files for line in file.describe())
        self.unverified = sum(file.unverified for file in files)

    def _read_by_rosbags(self) -> Iterator[McapMessage]:
        """Read sqlite3, and what rosbag2 has compressed by file or by message."""
        count = 0
        try:
            with Reader(self.path) as reader:
                for connection in reader.connections:
                    self._topic(connection.topic, connection.msgtype)
                wanted = [
                    connection
                    for connection in reader.connections
                    if self._topic(connection.topic, connection.msgtype)
                ]
                # With no connection chosen, rosbags reads all of them.
                for connection, received_ns, data in reader.messages(wanted) if wanted else ():
                    yield McapMessage(connection.topic, connection.msgtype, int(received_ns), data)
                    count += 1
        except InputError:
            raise
        except Exception as error:  # rosbags and what it is built on raise anything on bad bytes
            raise self._not_whole(error, f" after {count} messages") from None

    def _mcap_files(self) -> list[Path]:
        """Files that are read as they are; none where rosbags reads them."""
        if not self.path.is_dir():
            return [self.path] if self.path.suffix == ".mcap" else []
        try:
            text = (self.path / "metadata.yaml").read_text(encoding="utf-8")
            found = yaml.safe_load(text)["rosbag2_bagfile_information"]
            names = [PurePath(name).name for name in found["relative_file_paths"]]
            plain = not found["compression_mode"] and all(name.endswith(".mcap") for name in names)
            files = [self.path / name for name in names] if plain else []
        except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
            files = []
        if self._damaged and not all(map(Path.exists, files or [self.path / "metadata.yaml"])):
            files = sorted(self.path.glob("*.mcap"))
        return files

    def _topic(self, name: str, message_type: str) -> Topic | None:
        """Return the wanted topic of a channel, and note that it was found."""
        if (name, message_type) in self._channels:
            return self._channels[name, message_type]
        topic = next(
            (one for one in self._wanted if one.matches(name) and one.type == message_type), None
        )
        self._channels[name, message_type] = topic
        if topic is not None:
            names = sorted({self.topics.setdefault(topic.key, name), name})
            if len(names) > 1:
                allowed = f"only one topic may end in {topic.ending}; record one simulator a bag"
                raise refused(self.path, topic.key, ", ".join(names), allowed)
        return topic

    def _not_whole(
        self, reason: Exception | str, where: str = "", *, advice: bool = False
    ) -> InputError:
        text = " ".join(str(reason).split()) or type(reason).__name__
        allowed = "must be a whole rosbag2 recording, MCAP or sqlite3; "
        allowed += f"reading failed{where}: {text}; "
        allowed += "python -m sst_ros recover BAG makes a whole one of what is intact"
        if advice:
            allowed += ", --damaged reads it here"
        return refused(self.path, "bag", self.path.name, allowed)


@cache
def message_types() -> Any:
    """Return the message types of ROS 2 with their compiled (de)serializers."""
    return get_typestore(Stores.ROS2_KILTED)


def refused(path: Path, key: str, value: object, allowed: str) -> InputError:
    """Make the error about one fault of a recording."""
    return InputError(str(path), [Problem(key, value, allowed)])
