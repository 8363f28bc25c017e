# SPDX-License-Identifier: Apache-2.0
"""What a process asks of Fast DDS and takes from it, and how it ends."""

import math
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import rclpy
from programs import python
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from ros.conftest import torques
from std_msgs.msg import Float64MultiArray, String

from sst_ros.errors import SstError
from sst_ros.nodes import process, signals, topics

NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
MS = 1_000_000

SPEAKER = """
import time
from pathlib import Path
from types import SimpleNamespace
import rclpy
from rclpy.duration import Duration
from std_msgs.msg import String
from sst_ros.nodes import process
process.configure_middleware()
rclpy.init()
node = rclpy.create_node("speaker")
publisher = node.create_publisher(String, "said", 1000)
end = time.monotonic() + 60.0
while publisher.get_subscription_count() == 0 and time.monotonic() < end:
    time.sleep(0.01)
"""

SPEAK = """
for _ in range(4):
    publisher.publish(String(data="a word"))
    print(publisher.wait_for_all_acked(Duration(seconds=2.5)), flush=True)
"""

BURST = """
tasks = [task for task in Path("/proc/self/task").iterdir()
         if (task / "comm").read_text().startswith("dds.ev")]
def wakes():
    rows = ((task / "status").read_text() for task in tasks)
    return sum(int(row.partition("\\nvoluntary_ctxt_switches:")[2].split()[0])
               for row in rows)
before = wakes()
for _ in range(500):
    publisher.publish(String(data="a word"))
    time.sleep(0.001)
print(wakes() - before)
"""

QUIET = """
import gc, time
import rclpy
from sensor_msgs.msg import JointState
from sst_ros.nodes.simulator import Simulator
rclpy.init(args=["simulator", "--ros-args", "-p", "scene:=swing"])
simulator, samples = Simulator(), []
node = rclpy.create_node("observer")
node.create_subscription(JointState, "joint_states", samples.append, 10)
end = time.monotonic() + 60.0
def seen():
    return any(sample.header.frame_id == "" for sample in samples)
while not seen() and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(gc.isenabled(), len(gc.get_objects()))
simulator.close()
"""

HANGS = """
import ctypes, threading
import rclpy
from rclpy.node import Node
from sst_ros.nodes import process

class Hangs(Node):
    def destroy_node(self):
        # PyDLL holds the interpreter's lock as rclpy does in a deadlock of Fast DDS.
        ctypes.PyDLL(None).sleep(60)

class Worker:
    def __init__(self):
        self.node, self.done = Hangs("worker"), threading.Event()
        self.done.set()

    def close(self):
        print("closed", flush=True)

process._CLEAN_UP_S = 1.0
rclpy.init()
process.spin(Worker())
"""


@pytest.fixture
def no_profile(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def node(domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    yield rclpy.create_node("reader", context=context)
    rclpy.try_shutdown(context=context)


@pytest.fixture
def listener(node, no_profile):
    """The reader of a speaker: the middleware answers without an executor."""
    return node.create_subscription(String, "said", lambda _: None, 1000)


def test_readers_are_asked_often_what_has_arrived(listener):
    """By default they are asked every 3 s: the 2.5 s of waiting would pass in vain."""
    spoken = python(SPEAKER + SPEAK)
    assert spoken.stdout.split() == ["True"] * 4
    assert spoken.stderr == ""


def test_a_publication_does_not_wake_the_thread_for_events(listener):
    """By default each of them does: more than 500 times here."""
    assert int(python(SPEAKER + BURST).stdout) < 250


@pytest.mark.parametrize("name", NAMES)
def test_a_profile_of_the_user_is_left_alone(name, no_profile, monkeypatch):
    monkeypatch.setenv(name, "mine.xml")
    before = dict(os.environ)
    process.configure_middleware()
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("libraries", "name", "element"),
    [
        (["libfastrtps.so.2.14"], NAMES[0], "<heartbeatPeriod>"),
        (["libfastdds.so.3.2"], NAMES[1], "<heartbeat_period>"),
        ([], NAMES[1], "<heartbeat_period>"),
    ],
)
def test_each_generation_finds_its_own_file(
    libraries, name, element, no_profile, monkeypatch, tmp_path
):
    for library in libraries:
        (tmp_path / library).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", f"/nowhere:{tmp_path}")
    process.configure_middleware()
    (given,) = {
        each: os.environ.pop(each) for each in NAMES if each in os.environ
    }.items()
    assert given[0] == name
    assert element in Path(given[1]).read_text(encoding="utf-8")


@pytest.mark.breadth
def test_garbage_of_the_start_is_not_looked_through_again(domain):
    enabled, objects = python(QUIET).stdout.split()[:2]
    assert enabled == "False"
    assert int(objects) < 3000  # before: 12,000, with numba 63,000


@pytest.fixture
def looks(monkeypatch):
    made, original = [], topics.take
    monkeypatch.setattr(
        topics, "take", lambda reader: made.append(reader) or original(reader)
    )
    return made


@pytest.fixture
def reader(node):
    return topics.Reader(node, topics.SIMULATOR["commands"])


def publish(node, *torque):
    """Publish a command and wait until it has arrived."""
    publisher = node.create_publisher(
        Float64MultiArray, topics.SIMULATOR["commands"].name, 10
    )
    deadline = time.monotonic() + 30.0
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
        time.sleep(0.001)
    publisher.publish(torques(*torque))
    publisher.wait_for_all_acked()
    return publisher


def test_a_new_publishers_first_command_is_taken_within_20_ms(node, reader, looks):
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
    publisher.publish(torques(4.0, 5.0, 6.0))
    publisher.wait_for_all_acked()
    assert len(reader.read(at + 32 * MS)) == 1


def test_an_executor_sleeps_while_a_message_waits_to_be_taken(node, reader):
    """Fast DDS ends a wait for an event of a subscription at once while it has a
    message.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    assert not reader.read(time.monotonic_ns())
    publish(node, 1.0, 2.0, 3.0)
    for _ in range(20):
        executor.spin_once(timeout_sec=0.0)  # what else there was to do
    before = time.thread_time()
    executor.spin_once(timeout_sec=1.0)
    assert time.thread_time() - before < 0.05  # 0.002 asleep, up to 1.0 awake
    # without a time at once, not 20 ms after the last look
    assert len(reader.read(math.inf)) == 1
    executor.shutdown()


class Worker:
    """Runs `callback` once, 10 ms after its start."""

    def __init__(self, context, callback):
        self.node = Node("worker", context=context)
        self.done, self.entered, self.closed = (threading.Event() for _ in range(3))
        self.node.create_timer(0.01, lambda: (self.entered.set(), callback(self)))

    def close(self):
        self.closed.set()


@pytest.fixture
def stop(monkeypatch):
    request = set()
    monkeypatch.setattr(signals, "came", request)
    return request


def test_a_signal_ends_a_node_while_a_callback_waits_for_it(node, stop):
    worker = Worker(node.context, lambda own: own.closed.wait(60.0))
    threading.Thread(target=lambda: worker.entered.wait(60.0) and stop.add(2)).start()
    began = time.monotonic()
    process.spin(worker)
    # it would wait for 60 s
    assert worker.closed.is_set() and time.monotonic() - began < 30.0


def test_the_failure_of_a_callback_is_that_of_the_process(node, stop):
    def fail(own):
        raise SstError("the disk is full")

    worker = Worker(node.context, fail)
    with pytest.raises(SstError, match="the disk is full"):
        process.spin(worker)
    assert worker.closed.is_set()


def test_a_node_ends_though_its_middleware_hangs(domain):
    began = time.monotonic()
    ended = python(HANGS, status=1)
    assert time.monotonic() - began < 50.0  # it would wait for 60 s
    assert ended.stdout == "closed\n" and "in destroy_node" in ended.stderr


@pytest.mark.parametrize(("came", "longest_s"), [({2}, 1.2), (set(), 6.0)])
def test_a_node_whose_work_is_done_waits_for_its_subscribers(
    monkeypatch, came, longest_s
):
    """One that got a signal ends within 2 s; both say what was not received."""
    monkeypatch.setattr(signals, "came", came)
    waited, warnings = [], []

    def acknowledge(duration):
        waited.append(duration.nanoseconds)
        return False

    silent = SimpleNamespace(topic_name="/states", wait_for_all_acked=acknowledge)
    heard = SimpleNamespace(topic_name="/phase", wait_for_all_acked=lambda _: True)
    log = SimpleNamespace(warning=warnings.append)
    process._wait_for_subscribers(
        SimpleNamespace(publishers=[silent, heard], get_logger=lambda: log)
    )
    assert waited[0] == pytest.approx(1e9 * longest_s, rel=0.05)
    assert warnings == [
        f"subscribers have not received all of /states within {longest_s:g} s"
    ]
