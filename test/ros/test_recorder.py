# SPDX-License-Identifier: Apache-2.0
import re
import signal
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from sst_ros.nodes import topics

pytestmark = pytest.mark.ros


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_signals_leave_a_readable_bag_with_all_samples(nodes, observer, tmp_path, number):
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    simulator = nodes.run("simulator", wait_for_command=True, duration=0.3)
    assert nodes.line(recorder) == "ready: 9 topics\n"
    commands = observer.publisher(Float64MultiArray, "/sst_simulator/commands", readers=2)
    commands.publish(Float64MultiArray(data=[0.0, 0.0, 0.0]))
    assert simulator.wait(timeout=60) == 0
    status, _, err = nodes.stop(recorder, number)
    assert status == 0
    assert "Traceback" not in err
    types = get_typestore(Stores.ROS2_KILTED)
    stamps = []
    with Reader(tmp_path / "bag") as bag:
        for connection, _, data in bag.messages():
            if connection.topic == "/joint_states":
                header = types.deserialize_cdr(data, connection.msgtype).header
                if header.frame_id != "idle":
                    stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec)
    run = stamps
    assert run == [run[0] + 2_000_000 * k for k in range(151)]


def test_commands_are_read_when_all_that_a_simulator_says_is_heard(nodes, observer, tmp_path):
    """Who commands waits for their readers: what the recorder has not found would be lost."""
    node = "/sst_simulator"
    kinds = {
        "/joint_states": JointState,
        f"{node}/orientation": QuaternionStamped,
        f"{node}/euler_zyz": Vector3Stamped,
        f"{node}/applied_torques": JointTrajectory,
        f"{node}/scene": String,
        f"{node}/phase": String,
        "/diagnostics": DiagnosticArray,
    }
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def make(kind, topic, depth):
        is_latched = topic in (f"{node}/scene", f"{node}/phase")
        return observer.node.create_publisher(kind, topic, latched if is_latched else depth)

    speak = [(make(kind, topic, 10), kind()) for topic, kind in kinds.items() if "ori" not in topic]
    observer.node.create_subscription(Float64MultiArray, f"{node}/commands", print, 10)
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    said = 0

    def say_all(times):
        nonlocal said
        for publisher, message in speak:
            publisher.publish(message)
        said += all(publisher.get_subscription_count() for publisher, _ in speak)
        return said > times

    commanded = partial(observer.node.count_subscribers, f"{node}/commands")
    observer.until(partial(say_all, 20), "readers of all but one")  # 20 x 0.05 s: many looks
    assert commanded() == 1
    speak.append((make(QuaternionStamped, f"{node}/orientation", 10), QuaternionStamped()))
    observer.until(lambda: say_all(0) and commanded() == 2, "reader of the commands")
    assert nodes.line(recorder) == "ready: 8 topics\n"


def test_a_latched_topic_is_heard_though_its_subscriber_is_seen_first(
    nodes, observer, domain, tmp_path
):
    """As where a player starts before the simulator."""
    phase = "/sst_simulator/phase"
    observer.listen(String, phase, latched=True)
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics=f"[{phase}]")
    observer.until(lambda: observer.node.count_subscribers(phase) == 2, "the recorder")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    simulator = type(observer)(domain)  # that nobody has discovered yet
    try:
        simulator.node.create_publisher(String, phase, latched).publish(String(data="waiting"))
        assert nodes.line(recorder) == "ready: 1 topics\n"
        assert nodes.stop(recorder)[0] == 0
    finally:
        simulator.close()


@pytest.mark.parametrize("ending", ["timeout", "signal"])
def test_an_empty_bag_is_an_error_that_names_the_topics(nodes, observer, tmp_path, ending):
    timeout = 0.5 if ending == "timeout" else 0.0
    recorder = nodes.run("recorder", output=tmp_path / "bag", timeout=timeout)
    if ending == "timeout":
        _, err = recorder.communicate(timeout=60)
        assert "given up after 0.5 s" in err
    else:
        assert "recording to" in recorder.stderr.readline()
        _, _, err = nodes.stop(recorder)
    assert recorder.returncode == 1
    assert "is incomplete: no message of /diagnostics, /joint_states, /sst_simulator/app" in err
    assert "/sst_simulator/commands" not in err  # no run needs it
    assert "Traceback" not in err


def test_a_partial_bag_is_an_error_that_names_what_is_missing(nodes, observer, tmp_path):
    wanted = "[/joint_states, /sst_simulator/orientation]"
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics=wanted)
    states = observer.publisher(JointState, "/joint_states")
    states.publish(JointState())
    assert states.wait_for_all_acked()
    status, _, err = nodes.stop(recorder)
    assert status == 1
    assert "no message of /sst_simulator/orientation (1 messages of 1 topics recorded)" in err


def test_lost_messages_are_counted(nodes, observer, tmp_path):
    if version("ros-rclpy").startswith("7."):
        pytest.skip("sequence numbers do not reach the recorder with the rclpy of Jazzy")
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics="[/joint_states]")
    states = observer.node.create_publisher(JointState, "/joint_states", 1)
    observer.until(states.get_subscription_count, "the recorder")
    states.publish(JointState())
    assert nodes.line(recorder) == "ready: 1 topics\n"
    recorder.send_signal(signal.SIGSTOP)
    for _ in range(100):  # more than the transport holds for a reader that is away
        states.publish(JointState(effort=[0.0] * 10_000))
    recorder.send_signal(signal.SIGCONT)
    states.publish(JointState())
    assert states.wait_for_all_acked()
    status, _, err = nodes.stop(recorder)
    assert status == 1
    assert re.search(r"lost messages: \d+ of /joint_states", err), err


def test_an_existing_folder_is_refused(run_here, tmp_path):
    status, _, err = run_here("recorder", output=tmp_path)
    assert status == 1
    assert f"output = '{tmp_path}': must be a new folder" in err.replace("PosixPath", "")


def test_rosbag2_is_given_the_declared_qos():
    config = Path(__file__).parents[2] / "config"
    profiles = yaml.safe_load((config / "rosbag2_qos.yaml").read_text(encoding="utf-8"))
    assert set(profiles) == set((config / "topics.txt").read_text(encoding="utf-8").split())
    declared = {**topics.PLAYER, **topics.SIMULATOR}
    for topic, profile in profiles.items():
        own = declared.get(topic.rpartition("/")[2])
        latched = own is not None and own.latched
        assert profile["durability"] == ("transient_local" if latched else "volatile"), topic
        assert profile["reliability"] == "reliable"


def test_a_recorder_that_was_held_up_has_all_commands(nodes, observer, tmp_path):
    states = observer.listen(JointState, "/joint_states")
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    run = {"sync": "lockstep", "real_time_factor": 0.0, "duration": 1.0}
    simulator = nodes.run("simulator", **run)
    assert nodes.line(recorder).startswith("ready")
    nodes.run("torque_player", stamped=True, min_subscribers=2)
    observer.until(lambda: observer.stamp(states[-1]) if states else 0, "the run")
    recorder.send_signal(signal.SIGSTOP)
    heard = len(states)
    observer.until(lambda: len(states) > heard + 200, "samples")
    recorder.send_signal(signal.SIGCONT)
    assert simulator.wait(timeout=40) == 0
    status, _, err = nodes.stop(recorder)
    assert status == 0, err
