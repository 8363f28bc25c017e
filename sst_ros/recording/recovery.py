# SPDX-License-Identifier: Apache-2.0
"""Makes a whole recording of what is intact in one that was cut or damaged."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import WriterError

from sst_ros.errors import InputError, Problem
from sst_ros.recording.bag_writer import BagWriter
from sst_ros.recording.mcap_file import MAGIC, McapFile


class Recovered(NamedTuple):
    """A recovered recording.

    Attributes:
        bag: folder of the new recording.
        messages: number of messages in it.
        lost: number of messages known to be lost; those behind a cut are not known.
        cut: the old recording ends before its index.
        damage: what is damaged or lost, a line for each part.

    """

    bag: Path
    messages: int
    lost: int
    cut: bool
    damage: tuple[str, ...]


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write the intact messages of a recording into a new one.

    Args:
        path: folder with one .mcap file, or the file.
        out: folder of the new recording, which must not exist; `path` with _recovered behind by
            default.

    Raises:
        InputError: there is no such file, it is no MCAP, holds nothing, or `out` exists.

    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) != 1:
        raise _refused(path, len(files), "must hold one .mcap file")
    try:
        with files[0].open("rb") as opened:
            begin = opened.read(len(MAGIC))
    except OSError as problem:
        raise _refused(path, str(files[0]), f"must be readable ({problem})") from None
    if sum(one != right for one, right in zip(begin, MAGIC, strict=False)) > 1 or not begin:
        raise _refused(path, files[0].name, "must be an MCAP file")
    file = McapFile(files[0])
    target = out or path.with_name(f"{path.stem}_recovered")
    if target.exists():
        raise _refused(target, str(target), "must be a new folder")
    writer: BagWriter | None = None
    connections: dict[tuple[str, str], Connection] = {}
    unknown = 0
    for topic, kind, received_ns, data in file.messages():
        writer = writer or BagWriter(target)
        if not writer.knows(kind):
            unknown += 1
            continue
        if (topic, kind) not in connections:
            connections[topic, kind] = writer.connect(topic, kind)
        writer.write(connections[topic, kind], received_ns, data)
    if writer is None:
        raise _refused(path, 0, "holds no message that was saved")
    try:
        writer.close()
    except WriterError as problem:
        raise _refused(target, str(target), f"cannot be written ({problem})") from None
    damage = [*file.describe(), *([f"{unknown} messages of unknown types"] if unknown else [])]
    return Recovered(target, writer.messages, file.lost + unknown, file.cut, tuple(damage))


def _refused(path: Path, value: object, allowed: str) -> InputError:
    return InputError(str(path), [Problem("bag", value, allowed)])
