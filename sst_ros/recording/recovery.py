# SPDX-License-Identifier: Apache-2.0
"""A whole bag out of one that was cut: what its .mcap file holds, up to the cut. No rclpy in here.

A cut file has no index, so it is read from its beginning, record by record: a byte that says what
it is, eight that say how long, the content. Chunks hold records of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from struct import Struct, error
from typing import NamedTuple

from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem
from sst_ros.recording.bag_writer import VERSION

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_LENGTH, _SHORT, _INT = Struct("<Q"), Struct("<H"), Struct("<I")
_CHUNK_HEAD, _MESSAGE_HEAD = Struct("<QQQI"), Struct("<HIQQ")


class Recovered(NamedTuple):
    """What came out: the new bag, how many messages, and whether the old one was cut."""

    bag: Path
    messages: int
    cut: bool


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write the messages of a cut bag into a new one, `out` or `path` with _recovered behind.

    Args:
        path: folder with one .mcap file, or the file.
        out: folder of the new bag, which must not exist.

    Raises:
        InputError: there is no such file, it is no MCAP, holds nothing, or `out` exists.

    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) != 1:
        raise _refused(path, len(files), "must hold one .mcap file")
    try:
        content = files[0].read_bytes()
    except OSError as problem:
        raise _refused(path, str(files[0]), f"must be readable ({problem})") from None
    if not content.startswith(MAGIC):
        raise _refused(path, files[0].name, "must be an MCAP file")
    target = out or path.with_name(f"{path.stem}_recovered")
    typestore = get_typestore(Stores.ROS2_KILTED)
    topics: dict[int, tuple[str, str]] = {}
    kinds: dict[int, str] = {}
    count = 0
    try:
        with Writer(target, version=VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {}
            for kind, record in _records(memoryview(content)[len(MAGIC) :]):
                if kind == _SCHEMA:
                    kinds[_SHORT.unpack_from(record)[0]] = _text(record, 2)[0]
                elif kind == _CHANNEL:
                    number, schema = Struct("<HH").unpack_from(record)
                    topics[number] = (_text(record, 4)[0], kinds[schema])
                elif kind == _MESSAGE:
                    number, _, received_ns, _ = _MESSAGE_HEAD.unpack_from(record)
                    if number not in connections:
                        connections[number] = writer.add_connection(
                            *topics[number], typestore=typestore
                        )
                    data = bytes(record[_MESSAGE_HEAD.size :])
                    writer.write(connections[number], received_ns, data)
                    count += 1
    except (WriterError, OSError) as problem:
        raise _refused(target, str(target), f"must be a new folder ({problem})") from None
    if not count:
        raise _refused(path, 0, "holds no message that was saved")
    return Recovered(target, count, not content.endswith(MAGIC))


def _records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the records of the data section, those in chunks in place of the chunks."""
    at = 0
    while at + 9 <= len(content):
        kind, (length,) = content[at], _LENGTH.unpack_from(content, at + 1)
        record = content[at + 9 : at + 9 + length]
        at += 9 + length
        if kind == _DATA_END:
            return
        if kind == _CHUNK:
            yield from _chunk(record)
        elif len(record) == length:
            yield kind, record


def _chunk(record: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield the records of a chunk, which may be cut; only those that are whole come out."""
    try:
        compression, at = _text(record, _CHUNK_HEAD.size)
    except (error, UnicodeDecodeError):
        return
    if compression:
        raise _refused(Path("bag"), compression, "compressed chunks cannot be recovered")
    yield from _records(record[at + _LENGTH.size :])


def _text(record: memoryview, at: int) -> tuple[str, int]:
    (length,) = _INT.unpack_from(record, at)
    end = at + _INT.size + length
    return bytes(record[at + _INT.size : end]).decode(), end


def _refused(path: Path, value: object, allowed: str) -> InputError:
    return InputError(str(path), [Problem("bag", value, allowed)])
