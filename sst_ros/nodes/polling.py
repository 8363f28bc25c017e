# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that no executor spins: their owner takes the messages when and where it wants.

An executor wakes a thread for each message, which costs far more than taking it. rclpy has no
public call that takes a message; this is what its executors do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription

from sst_ros.nodes.topics import Endpoint


class NeverSpun(CallbackGroup):
    """Keeps subscriptions out of the executor."""

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


def reader(node: Node, topic: Endpoint) -> Callable[[], Any]:
    """Subscribe to a topic; the function returns its next message, or None."""
    subscription = node.create_subscription(
        topic.kind, topic.name, lambda _: None, topic.depth, callback_group=NeverSpun()
    )

    def next_message() -> Any:
        taken = take(subscription, raw=False)
        return None if taken is None else taken[0]

    return next_message
