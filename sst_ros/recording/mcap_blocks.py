# SPDX-License-Identifier: Apache-2.0
"""An MCAP file read in blocks: all messages of a chunk at once, not one by one.

rosbags gives messages singly, which takes longer than all that is done with them here. The format
is that of https://mcap.dev/spec; a record is a byte that says what it is, eight that say how long,
the content. Messages are told in the order of the file.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from struct import Struct
from struct import error as struct_error
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]

_MAGIC = b"\x89MCAP0\r\n"
_CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x04, 0x05, 0x06, 0x0F
_RECORD, _LENGTH, _INT = Struct("<BQ"), Struct("<Q"), Struct("<I")
_CHUNK_HEAD, _CHANNEL_HEAD = Struct("<QQQI"), Struct("<HHI")
_MESSAGE_HEAD, _CHANNEL_AT, _TIME_AT = 31, 9, 15
_LOOSE = 1 << 22


class Damaged(ValueError):
    """The file is no MCAP file, or not whole."""


class Block(NamedTuple):
    """Messages of one topic and one length.

    Attributes:
        topic: its name.
        received: when the recorder received them [ns], shape (n,).
        rows: serialized messages, shape (n, length).

    """

    topic: str
    received: Integers
    rows: Bytes


def blocks(path: Path, wanted: Collection[str]) -> Iterator[Block]:
    """Yield the messages of the wanted topics of a file.

    Raises:
        Damaged: the file is not whole.

    """
    topics: dict[int, str] = {}
    for records in _pieces(path):
        yield from _messages(records, topics, wanted)


def grouped(
    topic: str, received: Integers, data: Bytes, at: Integers, size: Integers
) -> Iterator[Block]:
    """Yield messages that lie at places of `data`, those of one length at a time."""
    for length in np.unique(size):
        chosen = size == length
        rows = np.lib.stride_tricks.sliding_window_view(data, int(length))[at[chosen]]
        yield Block(topic, received[chosen], rows)


def _pieces(path: Path) -> Iterator[bytes]:
    """Yield records in pieces: the content of chunks, and what lies between chunks."""
    whole = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise Damaged("it does not begin as an MCAP file does")
        loose: list[bytes] = []
        size = 0
        while True:
            head = _exactly(file, _RECORD.size)
            kind, length = _RECORD.unpack(head)
            if kind in (_CHUNK, _DATA_END) or size > _LOOSE:
                yield b"".join(loose)
                loose, size = [], 0
            if kind == _DATA_END:
                return
            if length > whole:
                raise Damaged(f"a record says that it is {length} bytes long")
            content = _exactly(file, length)
            if kind == _CHUNK:
                yield _unpacked(content)
            elif kind in (_CHANNEL, _MESSAGE):
                loose += [head, content]
                size += len(content)


def _messages(records: bytes, topics: dict[int, str], wanted: Collection[str]) -> Iterator[Block]:
    """Yield the wanted messages among records; channels that are met become `topics`."""
    starts, data = _starts(records), np.frombuffer(records, np.uint8)
    kinds = data[starts[:-1]]
    for start in starts[:-1][kinds == _CHANNEL].tolist():
        number, _, length = _CHANNEL_HEAD.unpack_from(records, start + _RECORD.size)
        name = start + _RECORD.size + _CHANNEL_HEAD.size
        topics[number] = records[name : name + length].decode()
    chosen = kinds == _MESSAGE
    at, size = starts[:-1][chosen], np.diff(starts)[chosen]
    if not len(at):
        return
    if size.min() < _MESSAGE_HEAD:
        raise Damaged("a message is shorter than its head")
    heads = np.lib.stride_tricks.sliding_window_view(data, _MESSAGE_HEAD)[at]
    channels = np.ascontiguousarray(heads[:, _CHANNEL_AT : _CHANNEL_AT + 2]).view("<u2")[:, 0]
    received = np.ascontiguousarray(heads[:, _TIME_AT : _TIME_AT + 8]).view("<i8")[:, 0]
    for channel in np.unique(channels).tolist():
        if channel not in topics:
            raise Damaged(f"messages of channel {channel}, which is not told")
        if topics[channel] not in wanted:
            continue
        here = channels == channel
        body = at[here] + _MESSAGE_HEAD
        yield from grouped(topics[channel], received[here], data, body, size[here] - _MESSAGE_HEAD)


def _starts(records: bytes) -> Integers:
    """Return where each record begins, and the end of the last one."""
    starts, at, end, length_at = [0], 0, len(records), _LENGTH.unpack_from
    try:
        while at < end:
            at += _RECORD.size + length_at(records, at + 1)[0]
            starts.append(at)
    except struct_error:
        at = -1
    if at != end:
        raise Damaged("a record is cut")
    return np.array(starts, dtype=np.int64)


def _unpacked(chunk: bytes) -> bytes:
    """Return the records in a chunk."""
    if len(chunk) < _CHUNK_HEAD.size + _INT.size:
        raise Damaged("a chunk is cut")
    _, _, size, check = _CHUNK_HEAD.unpack_from(chunk)
    (length,) = _INT.unpack_from(chunk, _CHUNK_HEAD.size)
    at = _CHUNK_HEAD.size + _INT.size + length
    name = chunk[_CHUNK_HEAD.size + _INT.size : at].decode()
    (packed,) = _LENGTH.unpack_from(chunk, at)
    content = chunk[at + _LENGTH.size : at + _LENGTH.size + packed]
    if name not in _DECOMPRESS:
        raise Damaged(f"unknown compression {name!r}")
    records = _DECOMPRESS[name](content)
    if len(records) != size or (check and zlib.crc32(records) != check):
        raise Damaged("the content of a chunk is not what was written")
    return records


def _lz4(content: bytes) -> bytes:
    import lz4.frame  # type: ignore[import-untyped]  # like zstd: rosbags brings it

    return bytes(lz4.frame.decompress(content))


_DECOMPRESS: dict[str, Callable[[bytes], bytes]] = {
    "": lambda content: content,
    "zstd": zstd.decompress,
    "lz4": _lz4,
}


def _exactly(file: BinaryIO, size: int) -> bytes:
    content = file.read(size)
    if len(content) != size:
        raise Damaged(f"it ends within a record, at byte {file.tell()}")
    return content
