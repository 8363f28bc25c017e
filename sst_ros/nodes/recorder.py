# SPDX-License-Identifier: Apache-2.0
"""The recorder: topics into a rosbag2 in MCAP, without a ROS installation.

Messages are never decoded: the serialized bytes go from DDS to the bag. They are taken
in batches from the subscriptions: 1850 messages a second cost 7 % of a core by this and
27 % by callbacks of an executor, measured in two processes at once.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rosbags import interfaces
from sensor_msgs.msg import JointState

from sst_ros.errors import SstError
from sst_ros.nodes import topics
from sst_ros.nodes.process import Worker, every
from sst_ros.recording.bag_writer import BagWriter
from sst_ros.runtime.settings import RecorderParameters
from sst_ros.scene.loads import JOINTS

_DEPTH = 10000
"""Messages of a topic that are kept until they are taken."""
_TAKE_PERIOD_S = 0.02
"""Period in which messages are taken."""
_LOOK_PERIOD_S = 0.2
"""Period of looks for new topics."""
_LOG_PERIOD_S = 5.0
"""What is waited for is not logged more often."""
_OF_A_RUN = ": run"
"""End of the name of a simulator's status in /diagnostics."""


def own_topics(
    requested: Iterable[str], default_nodes: Iterable[str]
) -> dict[str, topics.Endpoint]:
    """Return the topics of our nodes, by their full names.

    The nodes are those whose private topics are requested (NODE/scene, NODE/reference,
    ...), and those of the full names `default_nodes`: a last word such as `commands`
    alone says nothing.
    """
    tables = (topics.CONTROLLER, topics.SIMULATOR)
    nodes = set(default_nodes)
    for topic in requested:
        node, _, name = topic.rpartition("/")
        for table in tables:
            endpoint = table.get(name)
            if (
                endpoint is not None
                and endpoint.use == topics.PUBLISHES
                and endpoint.name.startswith("~")
            ):
                nodes.add(node)
    return {
        endpoint.at(node): endpoint
        for node in nodes
        for table in tables
        for endpoint in table.values()
        if endpoint.use in (topics.PUBLISHES, topics.SUBSCRIBES)
    }


def _is_of_simulator(message: Any) -> bool:
    """Whether a message can be that of a simulator.

    Others publish on its topic, too.
    """
    if isinstance(message, JointState):
        return set(JOINTS) <= set(message.name)
    if isinstance(message, DiagnosticArray):
        return any(status.name.endswith(_OF_A_RUN) for status in message.status)
    return True


@dataclass
class RecordedTopic:
    """A topic that is recorded; the connection is where its messages go in the bag.

    A gap in the sequence numbers is a loss where it is `counted`: a latched topic, of
    which only the last message matters, and /diagnostics may have gaps. It is `heard`
    with its first message, of a topic that is `shared` with other robots with the first
    of a simulator.
    """

    subscription: Subscription[Any]
    connection: interfaces.Connection
    counted: bool
    shared: bool
    heard: bool = False
    messages: int = 0
    lost: int = 0
    _last: dict[bytes, int] = field(default_factory=dict)

    def count(self, data: bytes, info: dict[str, Any]) -> None:
        """Count a message.

        Sequence numbers are those of its publisher, None on some middleware.
        """
        self.messages += 1
        if not self.heard:
            message_type = self.subscription.msg_type
            self.heard = not self.shared or _is_of_simulator(
                deserialize_message(data, message_type)
            )
        number = info.get("publication_sequence_number")
        publisher = info.get("publisher_gid")
        if self.counted and number and publisher:
            last = self._last.get(publisher["data"], number - 1)
            self.lost += max(0, number - last - 1)
            self._last[publisher["data"]] = number


class Recorder(Worker[RecorderParameters]):
    """Worker of the process `recorder`."""

    def __init__(self) -> None:
        super().__init__("sst_recorder", RecorderParameters)
        parameters = self.parameters
        self._requested = {
            self.node.resolve_topic_name(topic) for topic in parameters.topics if topic
        }
        default_nodes = [
            self.node.resolve_topic_name(name)
            for name in ("sst_simulator", "sst_inverse_dynamics")
        ]
        self._own = own_topics(self._requested, default_nodes)
        self._foreign = self._requested - self._own.keys()
        sampled = {
            topic
            for topic, endpoint in self._own.items()
            if endpoint.name in topics.SAMPLED
        }
        self._required = self._requested & sampled
        self._recorded: dict[str, RecordedTopic] = {}
        self._unknown: set[str] = set()
        self._ready = False
        self._failure: SstError | None = None
        self._timeout_s = parameters.timeout
        self._began_s = time.monotonic()
        folder = parameters.output
        if folder == "-":
            folder = f"sst_bag_{datetime.now():%Y%m%d_%H%M%S}"
        self._bag = BagWriter(Path(folder))
        self.node.get_logger().info(f"recording to {self._bag.path}")
        every(self.node, _LOOK_PERIOD_S, self._look)
        every(self.node, _TAKE_PERIOD_S, self._take)

    def close(self) -> None:
        """Take what has arrived and close the bag.

        Raises:
            SstError: topics have no messages, or some were lost.

        """
        self._take()
        if self._failure is not None:
            raise self._failure
        self._bag.close()
        heard = [topic for topic in self._recorded.values() if topic.messages]
        text = f"{self._bag.messages} messages of {len(heard)} topics recorded"
        self.node.get_logger().info(text)
        lost = [
            f"{recorded.lost} of {name}"
            for name, recorded in self._recorded.items()
            if recorded.lost
        ]
        missing = self._missing()
        faults = []
        if missing:
            faults.append(f"no message of {_join(missing)}")
        if lost:
            faults.append(f"lost messages: {_join(lost)}")
        if faults:
            raise SstError(
                f"{self._bag.path} is incomplete: {'; '.join(faults)} ({text})"
            )

    def _missing(self) -> set[str]:
        """Return the topics that must have messages and have none yet."""
        heard = {topic for topic, recorded in self._recorded.items() if recorded.heard}
        return (self._required | self._foreign) - heard

    def _look(self) -> None:
        """Subscribe to requested topics as they appear.

        Print once that all of them are recorded. Discovery finds the topics of a node
        one after the other: none may be new in the last look.
        """
        silent = self._missing() & self._required
        is_any_new = self._record_new_topics(is_heard=not silent)
        if self._ready:
            return
        waiting = silent | (self._foreign - self._recorded.keys())
        text = f"waiting for {_join(waiting or self._requested)}"
        log = self.node.get_logger()
        if self._recorded and not (is_any_new or waiting):
            self._ready = True
            print(f"ready: {len(self._recorded)} topics", flush=True)
        elif self._timeout_s and time.monotonic() - self._began_s > self._timeout_s:
            log.error(f"{text}: given up after {self._timeout_s:g} s")
            self.done.set()
        else:
            log.info(text, throttle_duration_sec=_LOG_PERIOD_S, skip_first=True)

    def _record_new_topics(self, *, is_heard: bool) -> bool:
        """Subscribe to requested topics that have appeared; return whether any has.

        Commands come last, when the simulator's own topics are heard: a player may wait
        for subscribers of its commands, and then expects that the run is recorded.
        """
        is_any_new = False
        for topic, types in self.node.get_topic_names_and_types():
            is_taken = topic in self._recorded or topic in self._unknown
            if topic not in self._requested or is_taken:
                continue
            is_any_new = True
            own = self._own.get(topic)
            if own is None or own.type_name not in types:
                first_type, *_ = types
                self._subscribe(topic, first_type, None)
            elif is_heard or own.use != topics.SUBSCRIBES:
                self._subscribe(topic, own.type_name, own)
        return is_any_new

    def _subscribe(
        self, topic: str, type_name: str, own: topics.Endpoint | None
    ) -> None:
        """Record a topic of a type; `own` is its row in our tables, if it is ours."""
        # a name that others chose must not get to the import
        if not self._bag.knows(type_name):
            text = f"{topic} is not recorded: its type {type_name} is unknown"
            self.node.get_logger().error(text)
            self._unknown.add(topic)
            return
        if own is not None:  # whatever discovery has found
            offers = [own.qos()]
        else:
            publishers = self.node.get_publishers_info_by_topic(topic)
            offers = [publisher.qos_profile for publisher in publishers]
        if not offers:
            return
        # What all publishers can serve.
        durability = DurabilityPolicy.VOLATILE
        reliability = ReliabilityPolicy.BEST_EFFORT
        if all(
            offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers
        ):
            durability = DurabilityPolicy.TRANSIENT_LOCAL
        if all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers):
            reliability = ReliabilityPolicy.RELIABLE
        qos = QoSProfile(depth=_DEPTH, durability=durability, reliability=reliability)
        message_type = topics.message_type(type_name)
        group = topics.NeverSpun()
        subscription = self.node.create_subscription(
            message_type, topic, lambda _: None, qos, callback_group=group, raw=True
        )
        counted = own is not None and not (own.latched or own.name.startswith("/"))
        connection = self._bag.connect(topic, type_name, [_bag_qos(qos)])
        shared = own is not None and not own.name.startswith("~")
        self._recorded[topic] = RecordedTopic(subscription, connection, counted, shared)

    def _take(self) -> None:
        """Write what has arrived; end where it cannot be written."""
        try:
            for topic in self._recorded.values():
                self._take_messages(topic)
            self._bag.save()
        except SstError as error:
            self._failure = error
            self.done.set()

    def _take_messages(self, topic: RecordedTopic) -> None:
        """Write the messages of a topic that have arrived."""
        while True:
            taken = topics.take(topic.subscription)
            if taken is None:
                return
            data, info = taken
            self._bag.write(topic.connection, info["received_timestamp"], data)
            topic.count(data, info)


def _bag_qos(qos: QoSProfile) -> interfaces.Qos:
    """QoS that a player of the bag offers: that of the subscription."""
    never = interfaces.QosTime(2147483647, 4294967295)
    return interfaces.Qos(
        history=interfaces.QosHistory.KEEP_LAST,
        depth=qos.depth,
        reliability=interfaces.QosReliability[qos.reliability.name],
        durability=interfaces.QosDurability[qos.durability.name],
        deadline=never,
        lifespan=never,
        liveliness=interfaces.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )


def _join(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
