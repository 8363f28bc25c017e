# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that no executor spins: their owner takes the messages when and where it wants.

An executor wakes a thread for each message, which costs far more than taking it. rclpy has no
public call that takes a message; this is what its executors do.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from sst_ros.nodes.topics import COUNT_NS, Endpoint
from sst_ros.runtime.torque_input import MOST_WAITING


class NeverSpun(CallbackGroup):
    """Keeps subscriptions out of the executor, and their events.

    In a wait for an event of a subscription of Fast DDS, each message that has not been taken ends
    the wait at once.
    """

    def can_execute(self, entity: object) -> bool:
        """Refuse."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Refuse."""
        return False

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
        waiting: a message is known that arrived after the time last given to `read`.

    """

    def __init__(self, node: Node, topic: Endpoint) -> None:
        self._subscription = node.create_subscription(
            topic.kind, topic.name, lambda _: None, topic.depth, callback_group=NeverSpun()
        )
        self._next: tuple[Any, int] | None = None
        self._count_ns = 0.0
        self._published = True
        self.waiting = False

    def read(self, until_ns: float) -> Sequence[Any]:
        """Return the next messages that arrived until this monotonic time [ns].

        They are MOST_WAITING at most. A topic without publishers is looked at every 20 ms, because
        a look costs 5 us in a run that wakes for each sample, with cold caches; at once where the
        time is infinite.
        """
        if self._count_ns <= until_ns < math.inf:
            self._count_ns = until_ns + COUNT_NS
            self._published = self._subscription.get_publisher_count() > 0
        elif not self._published and until_ns < math.inf:
            return ()
        found: list[Any] = []
        while len(found) < MOST_WAITING and (message := self._take(until_ns)) is not None:
            found.append(message)
        return found

    def _take(self, until_ns: float) -> Any:
        if self._next is None:
            # As bytes: otherwise an empty message is made each time that there is none.
            if (taken := take(self._subscription, raw=True)) is None:
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
