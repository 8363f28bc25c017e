# SPDX-License-Identifier: Apache-2.0
"""What the nodes ask of Fast DDS, and that it does it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sst_ros.nodes import process

NAMES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

LISTEN = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(String, "said", lambda message: None, 1000)
print("listening", flush=True)
rclpy.spin(node)
"""

SPEAKER = """
import time
import rclpy
from rclpy.duration import Duration
from std_msgs.msg import String
from sst_ros.nodes import process
process.configure_middleware()
rclpy.init()
node = rclpy.create_node("speaker")
publisher = node.create_publisher(String, "said", 1000)
end = time.monotonic() + 30.0
while publisher.get_subscription_count() == 0 and time.monotonic() < end:
    time.sleep(0.01)
"""

SPEAK = """
for _ in range(4):
    publisher.publish(String(data="a word"))
    print(publisher.wait_for_all_acked(Duration(seconds=1.0)), flush=True)
"""


QUIET = """
import gc, time
import rclpy
from sensor_msgs.msg import JointState
from sst_ros.nodes.simulator import Simulator
rclpy.init(args=["simulator", "--ros-args", "-p", "scene:=swing", "-p", "compiled:=true"])
simulator, samples = Simulator(), []
node = rclpy.create_node("observer")
node.create_subscription(JointState, "joint_states", samples.append, 10)
end = time.monotonic() + 30.0
while not any(sample.header.frame_id == "" for sample in samples) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(gc.isenabled(), len(gc.get_objects()))
simulator.close()
"""

BURST = """
from pathlib import Path
tasks = [task for task in Path("/proc/self/task").iterdir()
         if (task / "comm").read_text().startswith("dds.ev")]
def wakes():
    rows = (task / "status" for task in tasks)
    return sum(int(row.read_text().partition("\\nvoluntary_ctxt_switches:")[2].split()[0])
               for row in rows)
before = wakes()
for _ in range(500):
    publisher.publish(String(data="a word"))
    time.sleep(0.001)
print(wakes() - before)
"""


@pytest.fixture
def no_profile(monkeypatch):
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)


def heard(words):
    """Run a speaker beside a listener, each in a process of its own."""
    command = [sys.executable, "-c"]
    with subprocess.Popen([*command, LISTEN], stdout=subprocess.PIPE, text=True) as listener:
        try:
            assert listener.stdout.readline() == "listening\n"
            return subprocess.run(
                [*command, SPEAKER + words], capture_output=True, text=True, timeout=60, check=True
            )
        finally:
            listener.kill()


def test_readers_are_asked_often_what_has_arrived(domain, no_profile):
    """By default they are asked every 3 s: the second of waiting would pass in vain."""
    spoken = heard(SPEAK)
    assert spoken.stdout.split() == ["True"] * 4
    assert spoken.stderr == ""


@pytest.mark.parametrize("name", NAMES)
def test_a_profile_of_the_user_is_left_alone(name, no_profile, monkeypatch):
    monkeypatch.setenv(name, "mine.xml")
    before = dict(os.environ)
    process.configure_middleware()
    assert dict(os.environ) == before


@pytest.mark.parametrize(("rclpy", "name"), [("7.1.5", NAMES[0]), ("9.1.2", NAMES[1])])
def test_each_generation_finds_its_own_file(rclpy, name, no_profile, monkeypatch):
    monkeypatch.setattr(process, "version", lambda package: {"rclpy": rclpy}[package])
    process.configure_middleware()
    (given,) = {each: os.environ.pop(each) for each in NAMES if each in os.environ}.items()
    assert given[0] == name
    assert Path(given[1]).is_file()


def test_a_publication_does_not_wake_the_thread_for_events(domain, no_profile):
    """By default each of them does: more than 500 times here."""
    spoken = heard(BURST)
    assert int(spoken.stdout) < 250


def test_garbage_of_the_start_is_not_looked_through_again(domain):
    command = [sys.executable, "-c", QUIET]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    enabled, objects = found.stdout.split()[:2]
    assert enabled == "False"
    assert int(objects) < 3000  # before: 12,000, with numba 63,000
