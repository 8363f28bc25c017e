# SPDX-License-Identifier: Apache-2.0
"""Messages that the run takes by itself."""

import math
import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64MultiArray

from sst_ros.nodes import topics

MS = 1_000_000


@pytest.fixture
def node(domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    yield rclpy.create_node("reader", context=context)
    rclpy.try_shutdown(context=context)


@pytest.fixture
def looks(monkeypatch):
    made, original = [], topics.take

    def take(subscription):
        made.append(subscription)
        return original(subscription)

    monkeypatch.setattr(topics, "take", take)
    return made


def publish(node, *torque):
    """Publish a command and wait until it has arrived."""
    publisher = node.create_publisher(Float64MultiArray, topics.SIMULATOR["commands"].name, 10)
    deadline = time.monotonic() + 30.0
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
        time.sleep(0.001)
    publisher.publish(Float64MultiArray(data=torque))
    publisher.wait_for_all_acked()
    return publisher


def test_a_topic_without_a_publisher_is_looked_at_every_20_ms(node, looks):
    reader = topics.Reader(node, topics.SIMULATOR["commands"])
    for tick in range(100):
        assert not reader.read(tick * MS)
    assert len(looks) == 5


def test_the_first_command_of_a_new_publisher_is_taken_within_20_ms(node, looks):
    reader = topics.Reader(node, topics.SIMULATOR["commands"])
    at = time.monotonic_ns() + 10**12  # the test does not count its own time
    assert not reader.read(at)
    publisher = publish(node, 1.0, 2.0, 3.0)
    assert not reader.read(at + 19 * MS)
    (taken,) = reader.read(at + 20 * MS)
    assert list(taken.data) == [1.0, 2.0, 3.0]
    before = len(looks)
    for tick in range(10):
        assert not reader.read(at + (21 + tick) * MS)
    assert len(looks) == before + 10  # at each tick from now on
    publisher.publish(Float64MultiArray(data=[4.0, 5.0, 6.0]))
    publisher.wait_for_all_acked()
    assert len(reader.read(at + 32 * MS)) == 1


def test_without_a_time_every_command_is_taken_at_once(node):
    reader = topics.Reader(node, topics.SIMULATOR["commands"])
    assert not reader.read(time.monotonic_ns())
    publish(node, 1.0, 2.0, 3.0)
    assert len(reader.read(math.inf)) == 1


def test_an_executor_sleeps_while_a_message_waits_to_be_taken(node):
    """Fast DDS ends a wait for an event of a subscription at once while it has a message."""
    reader = topics.Reader(node, topics.SIMULATOR["commands"])
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    publish(node, 1.0, 2.0, 3.0)
    for _ in range(20):
        executor.spin_once(timeout_sec=0.0)  # what else there was to do
    before = time.thread_time()
    executor.spin_once(timeout_sec=1.0)
    assert time.thread_time() - before < 0.05  # 0.002 asleep, up to 1.0 awake
    assert len(reader.read(math.inf)) == 1
    executor.shutdown()
