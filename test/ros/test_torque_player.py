# SPDX-License-Identifier: Apache-2.0
import math
import signal

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

pytestmark = pytest.mark.ros


def test_plays_a_table_against_the_stamps_it_hears(nodes, observer, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.1,0.4,0.5,0.6\n0.2,0,0,0\n")
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    player = nodes.run("torque_player", csv=table, hold="start")
    states = observer.publisher(JointState, "/joint_states")
    for nanosec in (0, 500, 99_999_999 + 500, 100_000_000 + 500, 200_000_000 + 500):
        message = JointState()
        message.header.stamp.nanosec = nanosec
        before = len(heard)
        states.publish(message)
        observer.until(lambda before=before: len(heard) > before, "answer")
    expected = [[0.1, 0.2, 0.3]] * 3 + [[0.4, 0.5, 0.6], [0.0, 0.0, 0.0]]
    assert [list(message.data) for message in heard] == expected
    assert player.wait(timeout=10) == 0


def test_answers_with_the_torque_of_the_middle_of_the_hold(nodes, observer):
    """At the rate given; the last hold ends with the profile. Other periods are reported."""
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    player = nodes.run("torque_player", scene="example1", rate=250)
    states = observer.publisher(JointState, "/joint_states")
    end_ns = 523_598_776
    for nanosec in (0, 500, 500 + 4_000_000, 500 + 10_000_000, 500 + 522_000_000, 500 + end_ns):
        message = JointState()
        message.header.stamp.nanosec = nanosec
        before = len(heard)
        states.publish(message)
        observer.until(lambda before=before: len(heard) > before, "answer")
    last = (522_000_000 + end_ns) / 2 / 1e9
    expected = [1.13 * math.sin(12.0 * t) for t in (0.002, 0.002, 0.006, 0.012, last)]
    assert [list(message.data) for message in heard] == [[x] * 3 for x in [*expected, 0.0]]
    _, err = player.communicate(timeout=10)
    assert player.returncode == 0
    assert err.count("two samples are 0.006 s apart, not 1 / rate = 0.004 s") == 1


def test_a_rate_without_a_whole_period_is_refused(nodes):
    player = nodes.run("torque_player", rate=300)
    _, err = player.communicate(timeout=20)
    assert player.returncode == 1
    assert "rate = 300: must divide 1e9" in err


def test_the_last_sample_ends_it_though_its_reader_has_left(nodes, observer, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.1,0,0,0\n")
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    other = observer.node.create_subscription(
        Float64MultiArray, "/sst_simulator/commands", lambda message: None, 10
    )
    player = nodes.run("torque_player", csv=table, min_subscribers=2)
    states = observer.publisher(JointState, "/joint_states")
    message = JointState()
    message.header.stamp.nanosec = 500

    def begun():
        states.publish(message)
        return heard

    observer.until(begun, "torque")
    observer.node.destroy_subscription(other)
    message.header.stamp.nanosec = 100_000_500
    states.publish(message)
    observer.until(lambda: list(heard[-1].data) == [0.0, 0.0, 0.0], "end of the profile")
    assert player.wait(timeout=10) == 0


def test_a_player_that_was_held_up_counts_from_the_first_sample(nodes, observer, tmp_path):
    """Without it the profile would be late, and the run over before the profile is."""
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.2,0,0,0\n")
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    player = nodes.run("torque_player", csv=table)
    states = observer.node.create_publisher(JointState, "/joint_states", 1000)
    message = JointState()

    def called():
        states.publish(message)
        return heard

    observer.until(called, "torque")
    player.send_signal(signal.SIGSTOP)
    for sample in range(101):
        message.header.stamp.nanosec = 500 + 2_000_000 * sample
        states.publish(message)
    player.send_signal(signal.SIGCONT)
    assert player.wait(timeout=10) == 0


def test_silence_of_the_simulator_ends_it_with_a_message(nodes):
    player = nodes.run("torque_player", timeout=0.5)
    _, err = player.communicate(timeout=20)
    assert player.returncode == 1
    assert "no joint_states for" in err
    assert "Traceback" not in err


def test_a_bad_table_is_refused(nodes, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,1,2,nan\n")
    player = nodes.run("torque_player", csv=table)
    _, err = player.communicate(timeout=20)
    assert player.returncode == 1
    assert "line 2: row" in err
