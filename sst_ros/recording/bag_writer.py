# SPDX-License-Identifier: Apache-2.0
"""Writes a rosbag2 recording in MCAP chunk by chunk, or a damaged one anew.

Recordings are written with checksums.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Connection, MessageDefinitionFormat, Qos
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionMode

from sst_ros.errors import SstError, refusal, refuse_errors
from sst_ros.recording.bag_reader import McapFile, message_types

FLUSH_PERIOD_S = 1.0  # a process that is killed loses the messages of this time at most
_CHUNK_BYTES = 512 * 1024
"""Bounds what the writer holds when a flush comes late. Without a bound a recorder that
was held up for some seconds kept 1 to 4 MB more from then on; below 512 KiB nothing
more is gained, and the index grows, 0.7 to 1.2 kB a chunk, which stays in memory to the
end.
"""


class RecordingAborted(SstError):
    """The recording could not be written any further.

    What is in it can be recovered.
    """


class _McapStorage:
    """Storage of a rosbags writer: MCAP with checksums."""

    def __init__(self, path: Path, _: CompressionMode) -> None:
        self.path = path / f"{path.name}.mcap"
        self._file = self.path.open("xb")
        self._writer: Any = McapWriter(  # partly untyped
            self._file, _CHUNK_BYTES, CompressionType.NONE, enable_data_crcs=True
        )
        self._writer.start("ros2", "sst_ros")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        definition = connection.msgdef
        is_msg = definition.format == MessageDefinitionFormat.MSG
        self._schemas[connection.msgtype] = self._writer.register_schema(
            name=connection.msgtype,
            encoding="ros2msg" if is_msg else "ros2idl",
            data=definition.data.encode(),
        )

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        self._channels[connection.id] = self._writer.register_channel(
            topic=connection.topic,
            message_encoding="cdr",
            schema_id=self._schemas[connection.msgtype],
            metadata={"offered_qos_profiles": offered_qos_profiles},
        )

    def write(
        self, connection: Connection, timestamp: int, data: bytes | memoryview
    ) -> None:
        self._writer.add_message(
            self._channels[connection.id], timestamp, bytes(data), timestamp
        )

    def flush(self) -> None:
        self._writer.flush()

    def close(self, _: int, metadata: str) -> None:
        self._writer.add_metadata("rosbag2", {"serialized_metadata": metadata})
        self._writer.finish()
        self._file.close()

    def abort(self) -> None:
        self._file.close()


class BagWriter(Writer):
    """Writes messages; once a second all of them go to the file.

    A recording gets its index when it is closed. If that does not happen (kill -9, a
    full disk, a power cut) the messages that were flushed are in its .mcap file, and
    `recover` makes a whole recording of them. After that, and after `close`, `write`,
    `save` and `close` do nothing. Raises InputError where the folder exists or cannot
    be made, and from any method RecordingAborted when the file cannot be written.
    """

    STORAGE_PLUGINS = {StoragePlugin.MCAP: _McapStorage}  # noqa: RUF012  # as in its base

    def __init__(self, path: Path) -> None:
        self._typestore = message_types()
        self._flushed = time.monotonic()
        refused = "output", str(path), "must be a new folder"
        with refuse_errors("recorder", *refused, WriterError, OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            super().__init__(
                path, version=self.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP
            )
            self.open()

    @property
    def messages(self) -> int:
        """Number of messages that were written."""
        return sum(self.counts.values())

    def knows(self, message_type: str) -> bool:
        """Return whether messages of a type can be written."""
        return message_type in self._typestore.types

    def connect(
        self, topic: str, message_type: str, offered: Sequence[Qos] = ()
    ) -> Connection:
        """Add a topic; each only once."""
        return self.add_connection(
            topic, message_type, typestore=self._typestore, offered_qos_profiles=offered
        )

    def write(
        self, connection: Connection, timestamp: int, data: bytes | memoryview
    ) -> None:
        """Add a serialized message, received at a time [ns]."""
        self._try(super().write, connection, timestamp, data)

    def save(self) -> None:
        """Write all messages to the file, if that was FLUSH_PERIOD_S ago."""
        time_s = time.monotonic()
        is_due = time_s - self._flushed >= FLUSH_PERIOD_S
        if is_due and isinstance(self.storage, _McapStorage):
            self._flushed = time_s
            self._try(self.storage.flush)

    def close(self) -> None:
        """Write the index."""
        self._try(super().close)

    def _try(self, act: Callable[..., None], *arguments: Any) -> None:
        """Do something to the file unless it is closed; abort if that fails."""
        try:
            if self.storage is not None:
                act(*arguments)
        except OSError as error:
            with contextlib.suppress(OSError):
                self.abort()
            raise RecordingAborted(
                f"{self.path} is cut: {error}. Recording stopped after {self.messages}"
                " messages; recover those that were written by: python -m sst_ros"
                f" recover {self.path}"
            ) from None


class Recovered(NamedTuple):
    """A recovered recording."""

    bag: Path  # folder of the new recording
    messages: int  # in it
    lost: int  # messages known to be lost; those behind a cut are not known
    cut: bool  # the old recording ends before its index
    damage: tuple[str, ...]  # what is damaged or lost, a line for each part


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write the intact messages of a recording anew.

    The recording is a folder with one .mcap file, or the file. The new folder is `path`
    with _recovered behind by default. Raises InputError where there is no such file, it
    cannot be read or holds nothing, or where the new folder exists.
    """
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if len(files) != 1:
        raise refusal(path, "bag", len(files), "must hold one .mcap file")
    file = McapFile(files[0])
    target = out or path.with_name(f"{path.stem}_recovered")
    if target.exists():
        raise refusal(target, "bag", str(target), "must be a new folder")
    writer: BagWriter | None = None
    connections: dict[tuple[str, str], Connection] = {}
    unknown = 0
    with refuse_errors(str(path), "bag", str(files[0]), "must be readable", OSError):
        for topic, message_type, received_ns, data in file.messages():
            writer = writer or BagWriter(target)
            if not writer.knows(message_type):
                unknown += 1
                continue
            key = topic, message_type
            if key not in connections:
                connections[key] = writer.connect(topic, message_type)
            writer.write(connections[key], received_ns, data)
    if writer is None:
        raise refusal(
            path, "bag", files[0].name, "holds no message, or is no MCAP file"
        )
    with refuse_errors(
        str(target), "bag", str(target), "cannot be written", WriterError
    ):
        writer.close()
    damage = file.describe()
    if unknown:
        damage.append(f"{unknown} messages of unknown types")
    return Recovered(
        bag=target,
        messages=writer.messages,
        lost=file.lost + unknown,
        cut=file.cut,
        damage=tuple(damage),
    )
