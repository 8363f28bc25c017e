# SPDX-License-Identifier: Apache-2.0
"""Other nodes of the ROS graph, by name."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

_UNKNOWN = "_UNKNOWN_"
"""Part of the names that DDS has for nodes whose discovery is not finished."""
COUNT_NS = 20_000_000
"""A run counts the other ends of its topics this often, not at each tick: to count the subscribers
of four topics takes as long as a tick."""

UNNAMED = "a node whose name is not known yet"


def publishers(node: Node, topic: str, *, best_effort: bool = False) -> list[str]:
    """Full names of the nodes that publish a topic, one for each (best-effort) publisher."""
    return [
        full_name(info.node_namespace, info.node_name)
        for info in node.get_publishers_info_by_topic(topic)
        if not best_effort or info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    ]


def full_name(namespace: str, name: str) -> str:
    """Join a namespace and a name; names that are not yet known are put into words."""
    return UNNAMED if _UNKNOWN in name else f"{namespace.rstrip('/')}/{name}"
