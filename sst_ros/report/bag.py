# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 recording as a stream of messages; whatever is wrong with it becomes an InputError."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem


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
            raise _damaged(path, error) from None
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
            raise _damaged(self._path, error, f" after {count} messages") from None

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


def _damaged(path: Path, error: Exception, where: str = "") -> InputError:
    said = " ".join(str(error).split()) or type(error).__name__
    allowed = f"must be a whole rosbag2 recording, MCAP or sqlite3; reading failed{where}: {said};"
    allowed += " if the recorder was killed: python -m sst_ros recover BAG"
    return refused(path, "bag", path.name, allowed)


def _is_essential(topic: Topic) -> bool:
    return topic.essential
