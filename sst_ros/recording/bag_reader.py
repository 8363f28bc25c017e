# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 recording in blocks of messages; whatever is wrong with it becomes an InputError."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
import yaml
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem
from sst_ros.recording import mcap_blocks
from sst_ros.recording.mcap_blocks import Block

_BATCH = 20_000


class Topic(NamedTuple):
    """A topic to look for.

    Attributes:
        key: what the reader calls it.
        ending: how its name ends, or the whole name where `anywhere` is False.
        kind: message type.
        essential: a recording without it is refused.
        anywhere: any namespace and node name may precede the ending.

    """

    key: str
    ending: str
    kind: str
    essential: bool
    anywhere: bool = True

    def matches(self, name: str) -> bool:
        """Tell whether a topic has this one's name."""
        return name.endswith(self.ending) if self.anywhere else name == self.ending


class Message(NamedTuple):
    """One message: the key of its topic, when the recorder received it [ns], its content."""

    key: str
    received_ns: int
    content: Any


class Bag:
    """An open recording, MCAP or sqlite3, a folder or a single file; use it in a `with`.

    Attributes:
        topics: names of the topics found, by key.
        missing: keys of the topics that are not in the recording.

    Raises:
        InputError: there is no recording at the path, it is damaged, an essential topic is
            missing, or two topics match.

    """

    def __init__(self, path: Path, wanted: Sequence[Topic]) -> None:
        self._path = path
        self._store = get_typestore(Stores.ROS2_KILTED)
        if not path.exists():
            raise refused(path, "bag", str(path), "does not exist")
        try:
            self._reader = Reader(path)
            self._reader.open()
        except Exception as error:  # rosbags and what it is built on raise anything on bad bytes
            raise self.damaged(error) from None
        try:
            found = [self._find(topic) for topic in wanted]
            if not self._reader.message_count:
                raise refused(path, "messages", 0, "the recording is empty")
            absent = [topic for topic, match in zip(wanted, found, strict=True) if not match]
            if any(topic.essential for topic in absent):
                raise InputError(str(path), list(map(self._absence, filter(_is_essential, absent))))
        except InputError:
            self.close()
            raise
        pairs = [(topic, match) for topic, match in zip(wanted, found, strict=True) if match]
        self._connections = [connection for _, match in pairs for connection in match]
        self._keys = {match[0].topic: topic.key for topic, match in pairs}
        self._kinds = {topic.key: topic.kind for topic, _ in pairs}
        self._files = self._mcap_files()
        self.topics = {topic.key: match[0].topic for topic, match in pairs}
        self.missing = tuple(topic.key for topic in absent)

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(self) -> Iterator[Message]:
        """Yield the messages of all topics found, in the order in which they were received.

        Raises:
            InputError: the recording is damaged; `Problem.allowed` says how far it could be read.

        """
        count = 0
        try:
            for connection, received, raw in self._reader.messages(self._connections):
                content = self._store.deserialize_cdr(raw, connection.msgtype)
                yield Message(self._keys[connection.topic], int(received), content)
                count += 1
        except Exception as error:  # as above; what the caller raises does not come in here
            raise self.damaged(error, f" after {count} messages") from None

    def blocks(self) -> Iterator[Block]:
        """Yield the messages of all topics found, many at a time; a block's topic is its key.

        The blocks of a topic come in the order of the file, which may not be that of receptions.

        Raises:
            InputError: the recording is damaged; `Problem.allowed` says how far it could be read.

        """
        count = 0
        try:
            for block in self._mcap() if self._files else self._batches():
                yield block._replace(topic=self._keys[block.topic])
                count += len(block.received)
        except InputError:
            raise
        except Exception as error:  # as above
            raise self.damaged(error, f" after {count} messages") from None

    def content(self, block: Block) -> Iterator[Any]:
        """Deserialize the messages of a block one by one: for topics with few of them."""
        kind = self._kinds[block.topic]
        for row in block.rows:
            try:
                content = self._store.deserialize_cdr(row.tobytes(), kind)
            except Exception as error:  # as above
                raise self.damaged(error, f" in {block.topic}") from None
            yield content

    def damaged(self, error: Exception, where: str = "") -> InputError:
        """Make the error about bytes that are no recording."""
        said = " ".join(str(error).split()) or type(error).__name__
        allowed = "must be a whole rosbag2 recording, MCAP or sqlite3; "
        allowed += f"reading failed{where}: {said};"
        allowed += " if the recorder was killed: python -m sst_ros recover BAG"
        return refused(self._path, "bag", self._path.name, allowed)

    def _mcap(self) -> Iterator[Block]:
        for file in self._files:
            yield from mcap_blocks.blocks(file, self._keys)

    def _batches(self) -> Iterator[Block]:
        """Read sqlite3, and what rosbag2 has compressed, through rosbags."""
        messages = self._reader.messages(self._connections)
        while batch := list(itertools.islice(messages, _BATCH)):
            for topic in {connection.topic for connection, *_ in batch}:
                own = [(at, raw) for connection, at, raw in batch if connection.topic == topic]
                size = np.array([len(raw) for _, raw in own])
                data = np.frombuffer(b"".join(raw for _, raw in own), np.uint8)
                received = np.array([at for at, _ in own], dtype=np.int64)
                yield from mcap_blocks.grouped(topic, received, data, np.cumsum(size) - size, size)

    def _mcap_files(self) -> list[Path]:
        """Files to be read as they are; none where rosbags has to help."""
        files = [self._path]
        if self._path.is_dir():
            if self._reader.compression_mode:
                return []
            told = yaml.safe_load((self._path / "metadata.yaml").read_text(encoding="utf-8"))
            names = told["rosbag2_bagfile_information"]["relative_file_paths"]
            files = [self._path / PurePath(name).name for name in names]
        return files if all(file.suffix == ".mcap" for file in files) else []

    def _find(self, topic: Topic) -> list[Connection]:
        """Return the connections of the one topic that matches; each publisher may have its own."""
        matches = [
            connection
            for connection in self._reader.connections
            if topic.matches(connection.topic) and connection.msgtype == topic.kind
        ]
        names = sorted({connection.topic for connection in matches})
        if len(names) > 1:
            allowed = f"only one topic may end in {topic.ending}; record one simulator a bag"
            raise refused(self._path, topic.key, ", ".join(names), allowed)
        return matches

    def _absence(self, topic: Topic) -> Problem:
        others = {
            f"{connection.topic} ({connection.msgtype})"
            for connection in self._reader.connections
            if topic.matches(connection.topic)
        }
        allowed = f"no topic of type {topic.kind} ends in {topic.ending}; record it"
        return Problem(topic.key, ", ".join(sorted(others)) or None, allowed)


def refused(path: Path, key: str, value: object, allowed: str) -> InputError:
    """Make the error about one fault of a recording."""
    return InputError(str(path), [Problem(key, value, allowed)])


def _is_essential(topic: Topic) -> bool:
    return topic.essential
