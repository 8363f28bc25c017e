# SPDX-License-Identifier: Apache-2.0
import math
import signal

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

pytestmark = pytest.mark.ros


def sample(nanosec):
    message = JointState()
    message.header.stamp.nanosec = nanosec
    return message


def test_plays_a_table_against_the_stamps_it_hears(nodes, observer, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.1,0.4,0.5,0.6\n0.2,0,0,0\n")
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    player = nodes.run("torque_player", csv=table, hold="start")
    states = observer.publisher(JointState, "/joint_states")
    observer.publish_until(states, sample(0), lambda: heard, "answer to a state before the run")
    for nanosec in (500, 99_999_999 + 500, 100_000_000 + 500, 200_000_000 + 500):
        states.publish(sample(nanosec))
    observer.until(lambda: not any(heard[-1].data), "end of the profile")
    *before, second, last = (list(message.data) for message in heard)
    assert len(before) >= 3 and all(torque == [0.1, 0.2, 0.3] for torque in before)
    assert (second, last) == ([0.4, 0.5, 0.6], [0.0, 0.0, 0.0])
    assert player.wait(timeout=10) == 0


def test_answers_with_the_torque_of_the_middle_of_the_hold(nodes, observer):
    """At the rate given; the last hold ends with the profile. Other periods are reported."""
    heard = observer.listen(JointState, "/sst_simulator/commands_stamped")
    player = nodes.run("torque_player", scene="example1", rate=250, stamped=True)
    states = observer.publisher(JointState, "/joint_states")
    observer.publish_until(states, sample(0), lambda: heard, "answer to a state before the run")
    end_ns = 523_598_776
    stamps = [500 + passed for passed in (0, 4_000_000, 10_000_000, 522_000_000, end_ns)]
    for stamp in stamps:
        states.publish(sample(stamp))
    observer.until(lambda: heard[-1].header.stamp.nanosec == stamps[-1], "the last answer")
    last = (522_000_000 + end_ns) / 2 / 1e9
    expected = [1.13 * math.sin(12.0 * t) for t in (0.002, 0.006, 0.012, last)]
    answers = [(answer.header.stamp.nanosec, list(answer.effort)) for answer in heard]
    previews = [effort for stamp, effort in answers if stamp == 0]
    assert all(effort == [expected[0]] * 3 for effort in previews)
    efforts = [[torque] * 3 for torque in (*expected, 0.0)]
    assert answers[len(previews) :] == list(zip(stamps, efforts, strict=True))
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
    observer.publish_until(states, sample(500), lambda: heard, "torque")
    observer.node.destroy_subscription(other)
    states.publish(sample(100_000_500))
    observer.until(lambda: list(heard[-1].data) == [0.0, 0.0, 0.0], "end of the profile")
    assert player.wait(timeout=10) == 0


def test_a_player_that_was_held_up_counts_from_the_first_sample(nodes, observer, tmp_path):
    """Without it the profile would be late, and the run over before the profile is."""
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.2,0,0,0\n")
    heard = observer.listen(Float64MultiArray, "/sst_simulator/commands")
    player = nodes.run("torque_player", csv=table)
    states = observer.node.create_publisher(JointState, "/joint_states", 1000)
    observer.publish_until(states, sample(0), lambda: heard, "torque")
    player.send_signal(signal.SIGSTOP)
    for number in range(101):
        states.publish(sample(500 + 2_000_000 * number))
    player.send_signal(signal.SIGCONT)
    assert player.wait(timeout=10) == 0


def test_silence_of_the_simulator_ends_it_with_a_message(run_here):
    status, _, err = run_here("torque_player", timeout=0.5)
    assert status == 1
    assert "no joint_states for" in err


def test_a_bad_table_is_refused(run_here, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,1,2,nan\n")
    status, _, err = run_here("torque_player", csv=table)
    assert status == 1
    assert "line 2: row" in err
