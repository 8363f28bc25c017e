# SPDX-License-Identifier: Apache-2.0
"""Time in ROS: the clock that the simulator gives, and the clock that it follows."""

from __future__ import annotations

import threading
import time

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from sst_ros.errors import InputError, Problem
from sst_ros.nodes import topics
from sst_ros.nodes.raw_messages import Template

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For timers that must not stand still with simulated time."""

HEARD_GRAIN_NS = 200_000_000
"""Steps of a followed clock up to this long are run through; longer ones are dropped time."""

_DISCOVERY_S = 3.0
_LONGEST_WAIT_S = 0.05
_UNKNOWN = "_UNKNOWN_"


class OwnClock:
    """Publishes /clock; there must be no other.

    Raises:
        InputError: somebody publishes /clock already, or the node itself follows it.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        origin, given = node.get_fully_qualified_name(), "publish_clock"
        if follows_clock(node):
            allowed = "a node with use_sim_time follows /clock and cannot be its source"
            raise InputError(origin, [Problem(given, True, allowed)])
        deadline = time.monotonic() + _DISCOVERY_S
        others: list[str] = []
        while time.monotonic() < deadline and not (others and _UNKNOWN not in "".join(others)):
            others = sources(node)
            time.sleep(0.02)
        if others:
            allowed = f"/clock is published already, by {', '.join(others)}"
            raise InputError(origin, [Problem(given, True, allowed)])
        self._publisher = topics.CLOCK.publisher(node)
        self._message = Template(ClockMessage())
        self.now_ns = node.get_clock().now().nanoseconds

    def tell(self, now_ns: int) -> None:
        """Publish the time."""
        self.now_ns = now_ns
        self.repeat()

    def repeat(self) -> None:
        """Publish the time again, for those who come late."""
        self._publisher.publish(self._message.stamped(self.now_ns))

    def rivals(self) -> list[str]:
        """Names of other nodes that publish /clock."""
        found = sources(self._node)
        own = self._node.get_fully_qualified_name()
        if own in found:
            found.remove(own)
        return found


class HeardTime:
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
        """Tell the time [ns]; 0 before the first /clock."""
        return self._clock.now().nanoseconds

    def sleep(self, ns: int) -> None:
        """Wait for the next /clock."""
        self._moved.wait(_LONGEST_WAIT_S)
        self._moved.clear()


def follows_clock(node: Node) -> bool:
    """Tell whether use_sim_time is set."""
    return bool(node.get_parameter("use_sim_time").value)


def sources(node: Node) -> list[str]:
    """Full names of the nodes that publish /clock, one for each publisher."""
    infos = node.get_publishers_info_by_topic("/clock")
    return [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
