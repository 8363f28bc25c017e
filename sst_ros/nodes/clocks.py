# SPDX-License-Identifier: Apache-2.0
"""Time in ROS: the clock that the simulator publishes, and the clock that it follows."""

from __future__ import annotations

import threading
import time

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from sst_ros.errors import InputError, Problem
from sst_ros.nodes import topics
from sst_ros.nodes.graph import UNNAMED, publishers
from sst_ros.nodes.messages import clock_message, stamp

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For timers that must not stand still with simulated time."""

FOLLOWED_STEP_NS = 200_000_000
"""Steps of a followed clock up to this length are simulated; longer ones are dropped time."""

_DISCOVERY_S = 5.0
"""A participant of DDS whose first announcements were lost announces itself again within 3 s."""
_LONGEST_WAIT_S = 0.05


class PublishedClock:
    """Publishes /clock; there must be no other publisher.

    Raises:
        InputError: /clock is published already, or the node itself follows it.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        origin, name = node.get_fully_qualified_name(), "publish_clock"
        if follows_clock(node):
            allowed = "a node with use_sim_time follows /clock and cannot be its source"
            raise InputError(origin, [Problem(name, True, allowed)])
        deadline = time.monotonic() + _DISCOVERY_S
        others: list[str] = []
        while time.monotonic() < deadline and (not others or UNNAMED in others):
            others = publishers(node, "/clock")
            time.sleep(0.02)
        if others:
            allowed = f"/clock is published already, by {', '.join(others)}"
            raise InputError(origin, [Problem(name, True, allowed)])
        self._publisher = topics.CLOCK.publisher(node)
        self._message = clock_message()
        self.now_ns = node.get_clock().now().nanoseconds

    def publish(self, now_ns: int) -> None:
        """Publish the time."""
        self.now_ns = now_ns
        self.repeat()

    def repeat(self) -> None:
        """Publish the time again, for late subscribers."""
        self._publisher.publish(self._message.stamped(stamp(self.now_ns)))

    def rivals(self) -> list[str]:
        """Names of other nodes that publish /clock."""
        found = publishers(self._node, "/clock")
        own = self._node.get_fully_qualified_name()
        if own in found:
            found.remove(own)
        return found


class FollowedClock:
    """The ROS clock of a node with use_sim_time, as a time source of the pacer."""

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self._moved = threading.Event()
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1),
            min_backward=Duration(nanoseconds=-1),
            on_clock_change=True,
        )
        self._jumps = self._clock.create_jump_callback(
            threshold, post_callback=lambda _: self._moved.set()
        )

    def now_ns(self) -> int:
        """Return the time [ns]; 0 before the first /clock."""
        return int(self._clock.now().nanoseconds)

    def sleep(self, seconds: float, /) -> None:
        """Wait for the next /clock."""
        self._moved.wait(_LONGEST_WAIT_S)
        self._moved.clear()


def follows_clock(node: Node) -> bool:
    """Whether use_sim_time is set."""
    return bool(node.get_parameter("use_sim_time").value)
