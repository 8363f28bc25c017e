# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that no executor spins: their owner takes the messages when and where it wants.

An executor wakes a thread for each message, which costs far more than taking it. rclpy has no
public call that takes a message; this is what its executors do.
"""

from __future__ import annotations

import math
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from sst_ros.nodes.topics import Endpoint

_LOOK_NS = 20_000_000
"""Topics without publishers are looked at this often: to look costs 5 us at each wake, in which
the processor's caches are cold. An event says when the first publisher is there."""


class NeverSpun(CallbackGroup):
    """Keeps the messages of subscriptions out of the executor, but not their events."""

    def can_execute(self, entity: object) -> bool:
        """Refuse messages."""
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity: object) -> bool:
        """Refuse messages."""
        return not isinstance(entity, Subscription)

    def ending_execution(self, entity: object) -> None:
        """Do nothing."""


def take(subscription: Subscription[Any], *, raw: bool) -> tuple[Any, dict[str, Any]] | None:
    """Take the next message and its information, or None."""
    handle: Any = subscription.handle
    with handle:
        taken: tuple[Any, dict[str, Any]] | None = handle.take_message(subscription.msg_type, raw)
    return taken


class Reader:
    """Messages of a topic, each as soon as it has arrived.

    Attributes:
        waiting: a message is known that arrived after the time of the last `take`.

    """

    def __init__(self, node: Node, topic: Endpoint) -> None:
        events = SubscriptionEventCallbacks(matched=self._matched, use_default_callbacks=False)
        self._subscription = node.create_subscription(
            topic.kind, topic.name, lambda _: None, topic.depth,
            callback_group=NeverSpun(), event_callbacks=events,
        )  # fmt: skip
        self._next: tuple[Any, int] | None = None
        self._look_ns = 0.0
        self._publishers = 0
        self.waiting = False

    def take(self, until_ns: float) -> Any:
        """Return the next message if it arrived until this monotonic time [ns], or None."""
        if self._next is None:
            if until_ns < self._look_ns and not self._publishers:
                return None
            # As bytes: otherwise an empty message is made each time that there is none.
            if (taken := take(self._subscription, raw=True)) is None:
                self._look_ns = until_ns + _LOOK_NS if until_ns < math.inf else 0.0
                return None
            data, information = taken
            message = deserialize_message(data, self._subscription.msg_type)
            ago = max(0, time.time_ns() - information["received_timestamp"])
            self._next = message, time.monotonic_ns() - ago
        message, arrived_ns = self._next
        self.waiting = arrived_ns > until_ns
        if self.waiting:
            return None
        self._next = None
        return message

    def _matched(self, now: QoSSubscriptionMatchedInfo) -> None:
        """Count publishers: called by the thread of callbacks."""
        self._publishers = now.current_count
        self._look_ns = 0.0  # also after the last has left: for what it left
