# SPDX-License-Identifier: Apache-2.0
"""The messages of an MCAP file, verified by its checksums; damaged and cut files included.

Chunks carry a CRC-32 of their records, the summary (index) one of itself, and the end of the data
section one of all bytes before it. Files are read from the beginning, because one that was cut has
no index; after a damaged part reading resumes at the next chunk that is intact.
"""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Header, MessageIndex, Schema, Statistics

from sst_ros.recording.mcap_records import (
    ERRORS,
    MESSAGE,
    RECORD,
    Damage,
    frame,
    next_chunk,
    reason,
    records_of,
    stream,
)

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
