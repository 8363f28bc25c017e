# SPDX-License-Identifier: Apache-2.0
"""A bag that is being written: rosbag2 in MCAP, saved as it grows. No rclpy in here."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem, SstError

VERSION = 9
_SAVE_PERIOD_S = 1.0


class BagCut(SstError):
    """The bag could not be written any further; what is in it can be recovered."""


class BagFile:
    """Writes messages; once a second all of them go to the file.

    A bag gets its index when it is closed. If that does not happen (kill -9, a full disk, a power
    cut) the messages that were saved are in its .mcap file, and `recovery.recover` makes a whole
    bag of them.

    Attributes:
        messages: how many were written.

    Raises:
        InputError: the folder exists, or cannot be made.
        BagCut: by any method, when the file cannot be written.

    """

    def __init__(self, path: Path) -> None:
        self.path, self.messages = path, 0
        self._typestore = get_typestore(Stores.ROS2_KILTED)
        self._saved = time.monotonic()
        self._open = True
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = Writer(path, version=VERSION, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (WriterError, OSError) as error:
            allowed = f"must be a new folder ({error})"
            raise InputError("recorder", [Problem("output", str(path), allowed)]) from None

    def knows(self, kind: str) -> bool:
        """Tell whether messages of a type can be written."""
        return kind in self._typestore.types

    def connect(self, topic: str, kind: str, offered: Sequence[Qos]) -> Connection:
        """Add a topic."""
        return self._writer.add_connection(
            topic, kind, typestore=self._typestore, offered_qos_profiles=offered
        )

    def write(self, connection: Connection, received_ns: int, data: bytes) -> None:
        """Add a message as it came."""
        if self._open:
            try:
                self._writer.write(connection, received_ns, data)
            except OSError as error:
                raise self._cut(error) from None
            self.messages += 1

    def save(self) -> None:
        """Once a second: have everything in the file."""
        now = time.monotonic()
        if self._open and now - self._saved >= _SAVE_PERIOD_S:
            self._saved = now
            # rosbags has no public way to this; McapWriter does the same after 1 MiB.
            storage = self._writer.storage
            try:
                if storage.chunk.bio.tell():
                    storage.close_chunk()
                storage.bio.flush()
            except OSError as error:
                raise self._cut(error) from None

    def close(self) -> None:
        """Write the index; does nothing the second time and after a cut."""
        if self._open:
            try:
                self._writer.close()
            except OSError as error:
                raise self._cut(error) from None
            self._open = False

    def _cut(self, error: OSError) -> BagCut:
        self._open = False
        with contextlib.suppress(OSError):
            self._writer.abort()
        return BagCut(
            f"{self.path} is cut: {error}. Recording has stopped after {self.messages} messages; "
            f"make a whole bag of those saved by: python -m sst_ros recover {self.path}"
        )
