# SPDX-License-Identifier: Apache-2.0
"""The recorder: topics into a rosbag2 in MCAP, without a ROS installation.

Messages are never decoded: the serialized bytes go from DDS to the bag. They are taken in
batches, straight from the readers, because one executor wake-up a message costs far more.
"""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

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

from sst_ros.nodes import parameters, process, topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.raw_readers import NeverSpun, take
from sst_ros.recording.bag_writer import BagWriter
from sst_ros.runtime.settings import RecorderParameters

_DEPTH = 10000
_DRAIN_PERIOD_S = 0.02
_LOOK_PERIOD_S = 0.2


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
        self._aside = NeverSpun()
        dated = f"sst_bag_{datetime.now():%Y%m%d_%H%M%S}"
        self._bag = BagWriter(Path(dated if given.output == "-" else given.output))
        self.node.get_logger().info(f"recording to {self._bag.path}")
        self.node.create_timer(_LOOK_PERIOD_S, self._look, clock=STEADY)
        self.node.create_timer(_DRAIN_PERIOD_S, self._drain, clock=STEADY)

    def close(self) -> None:
        """Take what has arrived and close the bag."""
        self._drain()
        self._bag.close()
        said = f"{self._bag.messages} messages of {len(self._heard)} topics recorded"
        self.node.get_logger().info(said)

    def _look(self) -> None:
        """Subscribe to wanted topics as they appear; say once when all that speak were heard.

        DDS finds the topics of a node one after the other: none may have come since the last look.
        Commands have to wait until a simulator is heard on all of its own, see `_heard_first`.
        """
        settled = True
        for topic, kinds in self.node.get_topic_names_and_types():
            if topic in self._wanted and topic not in self._readers:
                settled = False
                if self._heard_first(topic) <= self._heard.keys():
                    self._subscribe(topic, kinds[0])
        speaking = {topic for topic in self._readers if self.node.count_publishers(topic)}
        if not self._ready and settled and speaking and speaking <= self._heard.keys():
            self._ready = True
            print(f"ready: {len(self._readers)} topics", flush=True)

    def _heard_first(self, topic: str) -> set[str]:
        """Wanted topics that a simulator always publishes, if the topic is one of its commands.

        Who commands may wait for readers of the commands, and then expects the run to be recorded.
        """
        node = topic.rpartition("/")[0]
        if topic not in _names(node, topics.SUBSCRIBES):
            return set()
        return _names(node, topics.PUBLISHES) & self._wanted

    def _subscribe(self, topic: str, kind: str) -> None:
        if not self._bag.knows(kind):  # also keeps names that others chose away from the import
            self.node.get_logger().error(f"{topic} is not recorded: its type {kind} is unknown")
            self._wanted.discard(topic)
            return
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
        connection = self._bag.connect(topic, kind, [_offered(asked)])
        reader = self.node.create_subscription(
            message_type, topic, lambda _: None, asked, callback_group=self._aside, raw=True
        )
        self._readers[topic] = (reader, connection)

    def _drain(self) -> None:
        for topic, (reader, connection) in self._readers.items():
            for data, received_ns in _taken(reader):
                self._bag.write(connection, received_ns, data)
                self._heard[topic] = self._heard.get(topic, 0) + 1
        self._bag.save()


def _names(node: str, use: str) -> set[str]:
    """Topics of a simulator's node that are always there."""
    return {one.at(node) for one in topics.SIMULATOR if one.use == use and not one.when}


def _taken(reader: Subscription) -> Iterator[tuple[bytes, int]]:
    while (result := take(reader, raw=True)) is not None:
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
