# SPDX-License-Identifier: Apache-2.0
"""The recorder: topics into a rosbag2 in MCAP, without a ROS installation.

Messages are never decoded: the serialized bytes go from DDS to the bag. They are taken in
batches, straight from the readers, because one executor wake-up a message costs far more.
"""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from sst_ros.errors import InputError, Problem
from sst_ros.nodes import parameters, process
from sst_ros.scene import share_directory
from sst_ros.schema import Section, text, texts

_BAG_VERSION = 9
_DEPTH = 10000
_DRAIN_PERIOD_S = 0.02
_LOOK_PERIOD_S = 0.2


def default_topics() -> tuple[str, ...]:
    """Topics in config/topics.txt, the list that `ros2 bag record` takes as well."""
    return tuple((share_directory() / "config" / "topics.txt").read_text().split())


@dataclass(frozen=True)
class RecorderParameters(Section):
    """Parameters of sst_recorder."""

    output: str = text(
        "folder of the bag, which must not exist yet; - for a dated name", default="-"
    )
    topics: tuple[str, ...] = texts("topics to record", default=default_topics())


class _NeverSpun(CallbackGroup):
    """Keeps the readers out of the executor: `Recorder._drain` takes their messages."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        return None


class Recorder:
    """Worker of the process `recorder`."""

    def __init__(self) -> None:
        self.node = Node("sst_recorder")
        self.done = threading.Event()
        given = parameters.declare(self.node, RecorderParameters)
        self._wanted = {self.node.resolve_topic_name(topic) for topic in given.topics}
        self._readers: dict[str, tuple[Subscription, Connection]] = {}
        self._heard: dict[str, int] = {}
        self._ready = False
        self._aside = _NeverSpun()
        self._typestore = get_typestore(Stores.ROS2_KILTED)
        dated = f"sst_bag_{datetime.now():%Y%m%d_%H%M%S}"
        path = Path(dated if given.output == "-" else given.output)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._bag = Writer(path, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
            self._bag.open()
        except (WriterError, OSError) as error:
            allowed = f"must be a new folder ({error})"
            raise InputError("recorder", [Problem("output", str(path), allowed)]) from None
        self.node.get_logger().info(f"recording to {path}")
        self.node.create_timer(_LOOK_PERIOD_S, self._look)
        self.node.create_timer(_DRAIN_PERIOD_S, self._drain)

    def close(self) -> None:
        """Take what has arrived and close the bag."""
        self._drain()
        self._bag.close()
        total = sum(self._heard.values())
        self.node.get_logger().info(f"{total} messages of {len(self._heard)} topics recorded")

    def _look(self) -> None:
        """Subscribe to wanted topics as they appear; say once when all that speak were heard."""
        for topic, kinds in self.node.get_topic_names_and_types():
            if topic in self._wanted and topic not in self._readers:
                self._subscribe(topic, kinds[0])
        speaking = {topic for topic in self._readers if self.node.count_publishers(topic)}
        if not self._ready and speaking and speaking <= self._heard.keys():
            self._ready = True
            print(f"ready: {len(self._readers)} topics", flush=True)

    def _subscribe(self, topic: str, kind: str) -> None:
        package, _, name = kind.split("/")
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)
        offers = [info.qos_profile for info in self.node.get_publishers_info_by_topic(topic)]
        latched = bool(offers) and all(
            offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers
        )
        reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
        asked = QoSProfile(
            depth=_DEPTH,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        )
        connection = self._bag.add_connection(
            topic, kind, typestore=self._typestore, offered_qos_profiles=[_offered(asked)]
        )
        reader = self.node.create_subscription(
            message_type, topic, lambda _: None, asked, callback_group=self._aside, raw=True
        )
        self._readers[topic] = (reader, connection)

    def _drain(self) -> None:
        for topic, (reader, connection) in self._readers.items():
            for data, received_ns in _taken(reader):
                self._bag.write(connection, received_ns, data)
                self._heard[topic] = self._heard.get(topic, 0) + 1


def _taken(reader: Subscription) -> Iterable[tuple[bytes, int]]:
    while True:
        with reader.handle:
            result: Any = reader.handle.take_message(reader.msg_type, True)
        if result is None:
            return
        data, info = result
        yield data, info["received_timestamp"]


def _offered(asked: QoSProfile) -> Qos:
    """QoS that a player of the bag offers: what the reader asked for."""
    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        asked.depth,
        QosReliability[asked.reliability.name],
        QosDurability[asked.durability.name],
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )


def main(args: list[str] | None = None) -> int:
    """Entry point of `recorder`."""
    return process.run("recorder", Recorder, args)


if __name__ == "__main__":
    sys.exit(main())
