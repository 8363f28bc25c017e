# SPDX-License-Identifier: Apache-2.0
"""What a recorder keeps, waits for and misses.

Cut recordings, and what comes out of them.
"""

import re
import resource
import select
import signal
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.writer import MCAP0_MAGIC
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros.conftest import COMMANDS, NODE
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from sst_ros.errors import InputError
from sst_ros.nodes import topics
from sst_ros.nodes.recorder import own_topics
from sst_ros.recording import bag_writer, recording
from sst_ros.scene.loads import JOINTS

pytestmark = pytest.mark.ros
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def own_message(kind):
    """A message that can be of a simulator."""
    message = kind()
    if kind is JointState:
        message.name = list(JOINTS)
    if kind is DiagnosticArray:
        message.status = [DiagnosticStatus(name=f"{NODE}: run")]
    return message


def recorded(nodes, observer, bag, **given):
    """A recorder and a simulator that runs."""
    recorder = nodes.run("recorder", output=bag)
    simulator = nodes.run(
        "simulator", wait_for_command=True, command_timeout=0.0, **given
    )
    assert nodes.line(recorder) == "ready: 9 topics\n"
    observer.command(0.0, 0.0, 0.0, readers=2)
    return recorder, simulator


def whole(bag, more_than):
    """Read a bag, which has so many samples of the run and no gap."""
    run = recording.read(bag)
    assert len(run.time_ns) > more_than
    assert np.array_equal(run.time_ns, np.arange(len(run.time_ns)) * 2_000_000)
    return run


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.breadth),
    ],
)
def test_signals_leave_a_readable_bag_with_all_samples(
    nodes, observer, tmp_path, number
):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag", duration=0.3)
    assert simulator.wait(timeout=60) == 0
    assert nodes.stop(recorder, number)[0] == 0
    assert len(whole(tmp_path / "bag", 150).time_ns) == 151


def test_commands_are_read_once_all_of_a_simulators_topics_are(
    nodes, observer, tmp_path
):
    """Who commands waits for their readers: what the recorder has not found would be
    lost.
    """

    def make(topic):
        publisher = observer.node.create_publisher(
            topic.kind, topic.at(NODE), topic.qos()
        )
        return publisher, own_message(topic.kind)

    own = [one for one in topics.SIMULATOR.values() if one.name in topics.SAMPLED]
    speak = [make(topic) for topic in own if topic.name != "~/orientation"]
    observer.node.create_subscription(Float64MultiArray, COMMANDS, print, 10)
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    said = 0

    def say_all(times):
        nonlocal said
        for publisher, message in speak:
            publisher.publish(message)
        said += all(publisher.get_subscription_count() for publisher, _ in speak)
        return said > times

    commanded = partial(observer.node.count_subscribers, COMMANDS)
    # 20 x 0.05 s: many looks
    observer.until(partial(say_all, 20), "readers of all but one")
    assert commanded() == 1
    speak.append(make(topics.SIMULATOR["orientation"]))
    observer.until(lambda: say_all(0) and commanded() == 2, "reader of the commands")
    assert nodes.line(recorder) == "ready: 8 topics\n"


@pytest.mark.breadth
def test_a_latched_topic_is_heard_if_its_subscriber_comes_first(
    nodes, observer, domain, tmp_path
):
    """As where a player starts before the simulator."""
    phase = f"{NODE}/phase"
    observer.listen(String, phase, latched=True)
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics=f"[{phase}]")
    observer.until(lambda: observer.node.count_subscribers(phase) == 2, "the recorder")
    simulator = type(observer)(domain)  # that nobody has discovered yet
    try:
        simulator.node.create_publisher(String, phase, LATCHED).publish(
            String(data="waiting")
        )
        assert nodes.line(recorder) == "ready: 1 topics\n"
        assert nodes.stop(recorder)[0] == 0
    finally:
        simulator.close()


def test_an_empty_bag_is_an_error_that_names_the_topics(nodes, tmp_path):
    recorder = nodes.run("recorder", output=tmp_path / "bag", timeout=0.5)
    assert "recording to" in recorder.stderr.readline()
    status, _, err = nodes.ended(recorder)
    assert status == 1 and "given up after 0.5 s" in err
    assert (
        "is incomplete: no message of /diagnostics, /joint_states, /sst_simulator/app"
        in err
    )
    assert COMMANDS not in err  # no run needs it


def test_a_partial_bag_is_an_error_that_names_what_is_missing(
    nodes, observer, tmp_path
):
    wanted = f"[/joint_states, {NODE}/orientation]"
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics=wanted)
    states = observer.publisher(JointState, "/joint_states")
    states.publish(own_message(JointState))
    assert states.wait_for_all_acked()
    status, _, err = nodes.stop(recorder)
    assert status == 1 and "given up" not in err
    assert (
        "no message of /sst_simulator/orientation (1 messages of 1 topics recorded)"
        in err
    )


def test_lost_messages_are_counted(nodes, observer, tmp_path):
    if version("ros-rclpy").startswith("7."):
        pytest.skip(
            "sequence numbers do not reach the recorder with the rclpy of Jazzy"
        )
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics="[/joint_states]")
    states = observer.node.create_publisher(JointState, "/joint_states", 1)
    observer.until(states.get_subscription_count, "the recorder")
    states.publish(own_message(JointState))
    assert nodes.line(recorder) == "ready: 1 topics\n"
    recorder.send_signal(signal.SIGSTOP)
    for _ in range(100):  # more than the transport holds for a reader that is away
        states.publish(JointState(effort=[0.0] * 10_000))
    recorder.send_signal(signal.SIGCONT)
    states.publish(own_message(JointState))
    assert states.wait_for_all_acked()
    status, _, err = nodes.stop(recorder)
    assert status == 1
    assert re.search(r"lost messages: \d+ of /joint_states", err), err


@pytest.mark.breadth
def test_another_robots_joint_states_do_not_stand_for_ours(nodes, observer, tmp_path):
    """They are recorded, as the topic is, but the recorder is not ready with them
    alone.
    """
    wanted = f"[/joint_states, {NODE}/scene]"
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics=wanted)
    states = observer.publisher(JointState, "/joint_states")
    scene = observer.node.create_publisher(String, f"{NODE}/scene", LATCHED)
    scene.publish(String(data="a scene"))
    observer.until(scene.get_subscription_count, "the recorder")
    gripper = JointState(name=["finger"], position=[0.0])
    for _ in range(20):  # at 20 Hz, for five looks
        states.publish(gripper)
        observer.executor.spin_once(timeout_sec=0.05)
    assert not select.select([recorder.stdout], [], [], 0.0)[0]
    states.publish(own_message(JointState))
    assert nodes.line(recorder) == "ready: 2 topics\n"
    assert nodes.stop(recorder)[0] == 0


def test_another_robots_joint_states_alone_are_an_incomplete_bag(
    nodes, observer, tmp_path
):
    recorder = nodes.run("recorder", output=tmp_path / "bag", topics="[/joint_states]")
    states = observer.publisher(JointState, "/joint_states")
    states.publish(JointState(name=["finger"], position=[0.0]))
    assert states.wait_for_all_acked()
    status, _, err = nodes.stop(recorder)
    assert (
        status == 1
        and "no message of /joint_states (1 messages of 1 topics recorded)" in err
    )


def test_topics_belong_to_the_nodes_of_private_topics_asked_for():
    requested = [
        "/left/joint_states",
        "/left/sim/phase",
        "/effort_controller/commands",
        "/joint_state_broadcaster/joint_states",
    ]
    own = own_topics(requested, ["/sst_simulator"])
    assert own["/left/joint_states"].use == own["/joint_states"].use == topics.PUBLISHES
    assert {"/left/sim/commands", "/sst_simulator/scene"} < own.keys()
    assert (
        not {"/effort_controller/commands", "/joint_state_broadcaster/joint_states"}
        & own.keys()
    )


def test_rosbag2_is_given_the_declared_qos():
    config = Path(__file__).parents[2] / "config"
    profiles = yaml.safe_load((config / "rosbag2_qos.yaml").read_text(encoding="utf-8"))
    assert set(profiles) == set(
        (config / "topics.txt").read_text(encoding="utf-8").split()
    )
    declared = {**topics.PLAYER, **topics.SIMULATOR}
    for topic, profile in profiles.items():
        own = declared.get(topic.rpartition("/")[2])
        latched = own is not None and own.latched
        assert profile["durability"] == (
            "transient_local" if latched else "volatile"
        ), topic
        assert profile["reliability"] == "reliable"


@pytest.mark.breadth
def test_a_recorder_that_was_held_up_has_all_commands(nodes, observer, tmp_path):
    states = observer.states  # from the beginning of the run
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    simulator = nodes.run(
        "simulator", sync="lockstep", real_time_factor=0.0, duration=1.0
    )
    assert nodes.line(recorder).startswith("ready")
    nodes.run("torque_player", stamped=True, min_subscribers=2)
    observer.until(observer.samples, "the run")
    recorder.send_signal(signal.SIGSTOP)
    heard = len(states)
    ended = simulator.poll  # on a busy machine the run may have ended before
    observer.until(lambda: len(states) > heard + 200 or ended() is not None, "samples")
    recorder.send_signal(signal.SIGCONT)
    assert simulator.wait(timeout=60) == 0
    assert nodes.stop(recorder)[0] == 0


def test_kill_of_the_simulator_leaves_a_whole_bag(nodes, observer, tmp_path):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag")
    # What the recorder of a busy machine has not taken yet is lost with the simulator.
    observer.told("samples_published", lambda n: int(n) > 1000)
    simulator.kill()
    simulator.communicate()
    assert nodes.stop(recorder)[0] == 0
    # The report says that it was cut.
    assert whole(tmp_path / "bag", 300).diagnostics["phase"] == "running"


@pytest.mark.breadth
def test_a_full_disk_ends_the_recorder_in_words(nodes, observer, tmp_path):
    recorder, simulator = recorded(nodes, observer, tmp_path / "bag")
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (700_000, 700_000))
    status, _, err = nodes.ended(recorder)
    assert status == 1 and "bag is cut: " in err and "sst_ros recover" in err
    observer.told("phase", "running")
    assert nodes.stop(simulator, signal.SIGTERM)[0] == 0
    whole(bag_writer.recover(tmp_path / "bag").bag, 100)


def test_what_cannot_be_recovered_is_refused(tmp_path):
    (tmp_path / "noise.mcap").write_bytes(b"no bag at all")
    (tmp_path / "empty.mcap").write_bytes(MCAP0_MAGIC)
    (tmp_path / "folder").mkdir()
    for names, said in (
        (["noise.mcap"], "holds no message"),
        (["empty.mcap"], "holds no message"),
        (["nowhere.mcap"], "must be readable"),
        (["folder"], "must hold one .mcap file"),
        (["empty.mcap", "folder"], "must be a new folder"),
    ):
        with pytest.raises(InputError, match=said):
            bag_writer.recover(*(tmp_path / name for name in names))
