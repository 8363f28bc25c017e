# SPDX-License-Identifier: Apache-2.0
"""Messages that the run takes by itself."""

import threading
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64MultiArray

from sst_ros.nodes import polling, topics

FAR_NS = 10**15
"""Later than any message of the test arrives, and not infinite."""


@pytest.fixture
def node(domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("reader", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield node
    executor.shutdown()
    rclpy.try_shutdown(context=context)
    thread.join(10.0)
    assert not thread.is_alive()


def until(condition):
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_topic_is_looked_at_rarely_until_it_has_a_publisher(node, monkeypatch):
    looks = []
    original = polling.take

    def take(subscription, *, raw):
        looks.append(subscription)
        return original(subscription, raw=raw)

    monkeypatch.setattr(polling, "take", take)
    reader = polling.Reader(node, topics.COMMANDS)
    now = time.monotonic_ns()
    for tick in range(100):
        assert reader.take(now + tick * 1_000_000) is None
    assert len(looks) == 5

    assert reader.take(now + FAR_NS) is None  # the next look without a publisher: far later
    publisher = node.create_publisher(Float64MultiArray, topics.COMMANDS.name, 10)
    publisher.publish(Float64MultiArray(data=[1.0, 2.0, 3.0]))
    taken = []
    until(lambda: taken or taken.extend(filter(None, [reader.take(now + FAR_NS)])))
    assert list(taken[0].data) == [1.0, 2.0, 3.0]


def test_what_the_last_publisher_left_is_taken_at_once(node):
    reader = polling.Reader(node, topics.COMMANDS)
    publisher = node.create_publisher(Float64MultiArray, topics.COMMANDS.name, 10)
    until(publisher.get_subscription_count)
    assert reader.take(FAR_NS) is None
    publisher.publish(Float64MultiArray(data=[1.0, 2.0, 3.0]))
    publisher.wait_for_all_acked()
    node.destroy_publisher(publisher)
    until(lambda: node.count_publishers(topics.COMMANDS.name) == 0)
    taken = []
    until(lambda: taken or taken.extend(filter(None, [reader.take(FAR_NS)])))
