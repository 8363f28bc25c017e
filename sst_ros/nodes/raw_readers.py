# SPDX-License-Identifier: Apache-2.0
"""Readers that no executor spins: their owner takes the messages, when and where it wants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription

from sst_ros.nodes import raw_handles
from sst_ros.nodes.topics import Endpoint


class NeverSpun(CallbackGroup):
    """Keeps readers out of the executor: one wake-up a message costs far more than taking it."""

    def can_execute(self, entity: object) -> bool:
        """Refuse."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Refuse."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Do nothing."""


def take(reader: Subscription, *, raw: bool) -> tuple[Any, dict[str, Any]] | None:
    """Take the next message and what is known about it, or None."""
    with reader.handle:
        result: tuple[Any, dict[str, Any]] | None = reader.handle.take_message(reader.msg_type, raw)
    return result


def reader(node: Node, topic: Endpoint) -> Callable[[], Any]:
    """Open a topic; the function gives its next message, or None."""
    subscription = node.create_subscription(
        topic.kind, topic.name, lambda _: None, topic.depth, callback_group=NeverSpun()
    )
    look, kind = raw_handles.keep(subscription.handle).take_message, topic.kind

    def next_message() -> Any:
        result = look(kind, False)
        return None if result is None else result[0]

    return next_message
