# SPDX-License-Identifier: Apache-2.0
"""What the player answers to joint states, and when it ends."""

import math
import signal

import pytest
from ros.conftest import COMMANDS, NAMES, STAMPED
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

pytestmark = pytest.mark.ros


def sample(nanosec):
    message = JointState(name=NAMES)
    message.header.stamp.nanosec = nanosec
    return message


def begin(nodes, observer, stamp=0, kind=Float64MultiArray, topic=COMMANDS, **given):
    """Start a player that has answered a state.

    Return it, the publisher and the answers.
    """
    heard = observer.listen(kind, topic)
    player = nodes.run("torque_player", stamped=kind is JointState, **given)
    states = observer.publisher(JointState, "/joint_states")
    observer.publish_until(states, sample(stamp), lambda: heard, "torque")
    return player, states, heard


def test_plays_a_table_against_the_stamps_it_hears(nodes, observer, profile):
    table = profile("0,0.1,0.2,0.3", "0.1,0.4,0.5,0.6", "0.2,0,0,0")
    player, states, heard = begin(nodes, observer, csv=table, hold="start")
    for nanosec in (500, 99_999_999 + 500, 100_000_000 + 500, 200_000_000 + 500):
        states.publish(sample(nanosec))
    observer.until(lambda: not any(heard[-1].data), "end of the profile")
    *before, second, last = (list(message.data) for message in heard)
    assert len(before) >= 3 and all(torque == [0.1, 0.2, 0.3] for torque in before)
    assert (second, last) == ([0.4, 0.5, 0.6], [0.0, 0.0, 0.0])
    assert nodes.ended(player)[0] == 0


def test_answers_with_the_torque_of_the_middle_of_the_hold(nodes, observer):
    """At the rate given; the last hold ends with the profile.

    Other periods are reported.
    """
    given = {"scene": "example1", "rate": 250}
    player, states, heard = begin(
        nodes, observer, kind=JointState, topic=STAMPED, **given
    )
    end_ns = 523_598_776
    stamps = [
        500 + passed for passed in (0, 4_000_000, 10_000_000, 522_000_000, end_ns)
    ]
    for stamp in stamps:
        states.publish(sample(stamp))
    observer.until(
        lambda: heard[-1].header.stamp.nanosec == stamps[-1], "the last answer"
    )
    last = (522_000_000 + end_ns) / 2 / 1e9
    expected = [1.13 * math.sin(12.0 * t) for t in (0.002, 0.006, 0.012, last)]
    answers = [(answer.header.stamp.nanosec, list(answer.effort)) for answer in heard]
    previews = [effort for stamp, effort in answers if stamp == 0]
    assert all(effort == [expected[0]] * 3 for effort in previews)
    efforts = [[torque] * 3 for torque in (*expected, 0.0)]
    assert answers[len(previews) :] == list(zip(stamps, efforts, strict=True))
    status, _, err = nodes.ended(player)
    assert status == 0
    assert err.count("two samples are 0.006 s apart, not 1 / rate = 0.004 s") == 1


@pytest.mark.parametrize("command", ["torque_player", "inverse_dynamics"])
def test_without_a_stamp_beside_lockstep_it_says_why_it_ends(nodes, command):
    nodes.run("simulator", sync="lockstep", duration=1.0)
    status, _, err = nodes.ended(nodes.run(command, stamped=False))
    assert status == 1 and "takes no command without a stamp: give stamped:=true" in err


def test_the_last_sample_ends_it_though_its_reader_has_left(nodes, observer, profile):
    table = profile("0,0.1,0.2,0.3", "0.1,0,0,0")
    other = observer.node.create_subscription(
        Float64MultiArray, COMMANDS, lambda _: None, 10
    )
    player, states, heard = begin(nodes, observer, 500, csv=table, min_subscribers=2)
    observer.node.destroy_subscription(other)
    states.publish(sample(100_000_500))
    observer.until(lambda: not any(heard[-1].data), "end of the profile")
    assert nodes.ended(player)[0] == 0


def test_a_player_that_was_held_up_counts_from_the_first_sample(
    nodes, observer, profile
):
    """Without it the profile would be late, and the run over before the profile is."""
    player, states, _ = begin(
        nodes, observer, csv=profile("0,0.1,0.2,0.3", "0.2,0,0,0")
    )
    player.send_signal(signal.SIGSTOP)
    for number in range(101):
        states.publish(sample(500 + 2_000_000 * number))
    player.send_signal(signal.SIGCONT)
    assert nodes.ended(player)[0] == 0
