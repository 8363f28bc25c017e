# SPDX-License-Identifier: Apache-2.0
"""The fault table, case by case, in real processes: nothing crashes, nothing is in
doubt.
"""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from missing_packages import needs
from rclpy.qos import QoSProfile
from ros.conftest import (
    COMMANDS,
    NAMES,
    NODE,
    STAMPED,
    children,
    is_running,
    named,
    torques,
)
from sensor_msgs.msg import JointState
from slow_cases import slow_after
from std_msgs.msg import Float64, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from sst_ros import Scene, load_scene
from sst_ros.description.robot import urdf
from sst_ros.runtime.torque_input import MOST_WAITING
from sst_ros.scene.yaml_document import dump, read

pytestmark = pytest.mark.ros
CALLS = 200
GOOD = (0.1, 0.2, 0.3)


PLAIN = [torques(1.0, 2.0), torques(math.nan, 0.0, 0.0)]
NAMED = [named([math.nan, 0.0, 0.0]), named([0.0] * 2, names=NAMES[:2])]


@pytest.mark.parametrize(
    ("good", "bad", "because", "said"),
    [
        pytest.param(torques(*GOOD), PLAIN, "wrong size 1, not finite 1",
                     "must be 3 finite torques", marks=pytest.mark.breadth),
        (named(GOOD[::-1], names=NAMES[::-1]), NAMED, "not finite 1, wrong names 1",
         "must be gamma_1, gamma_2, gamma_3, each once"),
    ],
    ids=["plain", "stamped"],
)  # fmt: skip
def test_bad_commands_are_dropped_whole_and_counted(
    nodes, observer, good, bad, because, said
):
    process = nodes.run("simulator", wait_for_command=True, command_timeout=0.0)
    observer.preview()
    kind = type(good)
    commands = observer.publisher(
        kind, COMMANDS if kind is Float64MultiArray else STAMPED
    )
    commands.publish(good)
    observer.until(lambda: GOOD in observer.torques(), "the command")
    for message in bad:
        commands.publish(message)
    told = observer.told("commands_dropped", len(bad))
    assert (told["commands_received"], told["commands_dropped_because"]) == (
        "1",
        because,
    )
    assert told["level"] == b"\x01" and said in told["said"]
    assert observer.torques()[-1] == GOOD
    status, _, err = nodes.stop(process)
    warnings = [line for line in err.splitlines() if "command dropped" in line]
    # One for each report that finds new ones, however many commands.
    assert status == 0 and len(warnings) == len(
        {*observer.said("commands_dropped")} - {"0"}
    )
    assert said in warnings[-1] and f"({len(bad)} in all)" in warnings[-1]


def test_limit_and_external_moment_are_those_of_the_scene(nodes, observer, tmp_path):
    applied = observer.listen(JointTrajectory, f"{NODE}/applied_torques")
    more = "actuators: {torque_limit: 0.5}\nmoment: {topic: true}\n"
    (path := tmp_path / "variant.yaml").write_text(dump(load_scene("example2")) + more)
    nodes.run("simulator", scene=path, command_timeout=0.0)
    observer.command(7.0, -7.0, 0.1)
    observer.until(
        lambda: (0.5, -0.5, 0.1) in observer.torques(), "the clamped command"
    )
    said = observer.told("commands_clamped", 1)
    assert (
        said["level"] == b"\x01"
        and "clamped to the scene's torque limit" in said["said"]
    )

    moments = observer.publisher(WrenchStamped, f"{NODE}/external_moment")
    message = WrenchStamped()
    message.wrench.torque.z = 0.25
    moments.publish(message)
    observer.until(
        lambda: any(p.effort[5] == 0.25 for m in applied for p in m.points),
        "the moment",
    )
    assert applied[-1].joint_names == [*NAMES, "moment_x", "moment_y", "moment_z"]
    message.wrench.torque.z = math.nan
    moments.publish(message)
    observer.told("commands_dropped_because", "not finite 1")


def test_a_moment_is_taken_in_a_scene_without_one_when_asked(nodes, observer):
    applied = observer.listen(JointTrajectory, f"{NODE}/applied_torques")
    scenes = observer.listen(String, f"{NODE}/scene", latched=True)
    nodes.run("simulator", scene="example2", external_moment=True)
    moments = observer.publisher(WrenchStamped, f"{NODE}/external_moment")
    message = WrenchStamped()
    message.wrench.torque.y = 0.25
    observer.publish_until(
        moments,
        message,
        lambda: any(0.25 in p.effort[4:5] for m in applied for p in m.points),
        "the moment",
    )
    assert read(Scene, scenes[-1].data, "scene").moment.topic  # for who reads the run


def test_a_moment_beside_a_constant_one_is_refused(run_here, tmp_path):
    path = tmp_path / "loaded.yaml"
    path.write_text(dump(load_scene("example2")) + "moment: {value: [0, 0, 1]}\n")
    status, out, err = run_here("simulator", scene=path, external_moment=True)
    assert (status, out) == (1, "")
    assert "external_moment = True: must be false" in err
    assert "has a constant moment" in err


def test_two_publishers_are_told_and_moments_not_taken(nodes, observer):
    process = nodes.run("simulator")
    observer.publisher(Float64MultiArray, COMMANDS)
    observer.publisher(JointState, STAMPED)
    said = observer.told("command_publishers", 2)
    assert "2 publishers of commands" in said["said"] and said["level"] == b"\x01"
    # The scene has no moment from a topic.
    assert observer.node.count_subscribers(f"{NODE}/external_moment") == 0
    _, _, err = nodes.stop(process)
    assert "2 publishers of commands" in err


def test_a_message_of_another_type_is_reported(nodes, observer):
    """DDS does not deliver it: nothing else would say why the torques stay zero."""
    process = nodes.run("simulator")
    observer.node.create_publisher(Float64, COMMANDS, 10)
    text = (
        f"{COMMANDS} of /observer is std_msgs/msg/Float64 and not received: "
        "must be std_msgs/msg/Float64MultiArray"
    )
    said = observer.told("said", lambda said: text in said)
    assert said["level"] == b"\x01"
    assert (
        observer.listen(DiagnosticArray, "/diagnostics")[-1].status[0].hardware_id
        == NODE
    )
    _, _, err = nodes.stop(process)
    assert err.count(text) == 1


def test_commands_that_wait_for_a_held_up_process_are_all_used(nodes, observer):
    """A busy machine hands over at once what has arrived in a while."""
    process = nodes.run("simulator")
    commands = observer.publisher(Float64MultiArray, COMMANDS)
    observer.phase("running")
    process.send_signal(signal.SIGSTOP)
    for number in range(MOST_WAITING):
        commands.publish(torques(*[number / 1000.0] * 3))
    process.send_signal(signal.SIGCONT)
    observer.told("commands_received", MOST_WAITING)


@pytest.mark.slow
def test_a_flood_of_commands_is_bounded(nodes, observer):
    """20 kHz for a second, 200 a tick, if the machine can: no crash, no growth, samples
    go on.
    """
    process = nodes.run("simulator", rate=100, publish_rate=100)
    commands = observer.publisher(Float64MultiArray, COMMANDS)
    observer.phase("running")
    before, start = _memory(process.pid), time.monotonic()
    messages = [torques(*[number] * 3) for number in (0.0, math.nan)]
    for sent in range(20_000):
        commands.publish(messages[sent % 2])
        if sent % 20 == 19:
            time.sleep(max(0.0, start + sent / 20_000 - time.monotonic()))
    ticks = int(observer.told("commands_dropped", lambda n: int(n) > 100)["ticks"])
    said = observer.told("ticks", lambda n: int(n) > ticks + 50)
    taken = int(said["commands_received"]) + int(said["commands_dropped"])
    assert taken <= MOST_WAITING * int(said["ticks"])
    assert said["phase"] == "running" and said["fault"] == ""
    assert _memory(process.pid) - before < 20_000  # kB
    assert nodes.stop(process)[0] == 0


@pytest.mark.breadth
def test_every_one_of_many_calls_at_once_is_answered(nodes, observer):
    nodes.run("simulator")
    observer.phase("running")
    # of the replies: a client of rclpy keeps ten by default
    qos = QoSProfile(depth=CALLS)
    client = observer.node.create_client(SetBool, f"{NODE}/pause", qos_profile=qos)
    observer.until(client.service_is_ready, "the service")
    calls = [client.call_async(SetBool.Request(data=True)) for _ in range(CALLS)]
    observer.until(lambda: all(call.done() for call in calls), "replies")
    assert all(call.result().success for call in calls)


@pytest.mark.breadth
def test_kill_of_a_view_ends_its_simulator(nodes, observer):
    looking = (
        "from sst_ros.view.source import run_simulator\nwith run_simulator('swing'):"
        " input()"
    )
    viewer = subprocess.Popen([sys.executable, "-c", looking], stdin=subprocess.PIPE)
    observer.until(
        lambda: "sst_simulator" in observer.node.get_node_names(), "simulator"
    )
    (simulator,) = children(viewer)
    viewer.kill()
    viewer.communicate()
    observer.until(lambda: not is_running(simulator), "end of it")


def test_a_late_joiner_learns_what_is_simulated_and_what_it_does(nodes, observer):
    nodes.run("simulator", scene="general", real_time_factor=0.1)
    observer.told("phase", "running")
    scene = observer.listen(String, f"{NODE}/scene", latched=True)
    drawn = observer.listen(String, "/robot_description", latched=True)
    observer.until(lambda: scene and observer.phases and drawn, "latched messages")
    assert observer.phases == ["running"]
    assert read(Scene, scene[0].data, "topic") == load_scene("general")
    assert drawn[0].data == urdf(load_scene("general"))
    assert '<link name="base_link">' in drawn[0].data


def test_a_fault_is_held_still_until_a_reset_and_ends_the_player(
    nodes, observer, profile
):
    process = nodes.run("simulator", scene="example2_heavy", wait_for_command=True)
    observer.preview()
    player = nodes.run("torque_player", csv=profile("0,50,0,0", "60,0,0,0"))
    status, _, err = nodes.ended(player)
    assert status == 1 and "the simulator stopped: fault: stopped at" in err
    said = observer.told("phase", "fault")
    assert said["level"] == b"\x02" and "gamma_1 > 1.570796 rad" in said["fault"]
    assert not observer.pause(False).success
    observer.until(observer.samples, "samples")
    observer.until(lambda: observer.stamp(observer.states[-1]) == 0, "the held state")
    held, sample = observer.states[-1], observer.samples()[-1]
    assert list(held.position) == list(sample.position)
    assert any(sample.velocity) and not any(held.velocity) and not any(held.effort)
    assert observer.call(Trigger, f"{NODE}/reset").success
    observer.told("phase", "waiting")
    assert observer.said("fault")[-1] == ""
    _, _, err = nodes.stop(process)
    assert "held until ~/reset" in err and "gamma_1 > 1.570796 rad" in err


RECORDER = pytest.param("recorder", marks=needs("rosbags", "mcap"))


@pytest.mark.parametrize(
    "command",
    slow_after(1, ["simulator", RECORDER, "torque_player"], mark=pytest.mark.breadth),
)
def test_signals_twice_end_a_node_once(nodes, observer, tmp_path, command):
    is_recorder = command == "recorder"
    process = nodes.run(
        command, **({"output": tmp_path / "bag"} if is_recorder else {})
    )
    observer.until(
        lambda: f"sst_{command}" in observer.node.get_node_names(), "the node"
    )
    process.send_signal(signal.SIGTERM)
    process.send_signal(signal.SIGINT)
    status, _, err = nodes.stop(process, signal.SIGTERM)
    assert status == is_recorder, err  # its bag is empty


def _memory(pid):
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
