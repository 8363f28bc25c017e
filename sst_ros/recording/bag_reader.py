# SPDX-License-Identifier: Apache-2.0
"""The messages of a rosbag2 recording in one pass; every fault of it becomes an InputError."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import yaml
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem
from sst_ros.recording.mcap_file import McapFile, McapMessage


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
