# SPDX-License-Identifier: Apache-2.0
"""Records of MCAP files: frames, chunks with their checksums, and parts that are damaged.

A record is one byte opcode, eight bytes length, content (https://mcap.dev/spec).
"""

from __future__ import annotations

import mmap
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from struct import Struct
from struct import error as StructError

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk, MessageIndex

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
