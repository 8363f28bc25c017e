# SPDX-License-Identifier: Apache-2.0
"""Speeds, /clock given and /clock followed."""

import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

pytestmark = pytest.mark.ros
NODE = "/sst_simulator"


def clock(nanoseconds):
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 10**9)
    return message


@pytest.mark.parametrize("speed", [0.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_other_speeds_are_kept_and_lose_no_sample(nodes, observer, speed):
    states = observer.listen(JointState, "/joint_states")
    process = nodes.run(
        "simulator", real_time_factor=speed, duration=2.0, publish_rate=100, wait_for_command=True
    )
    observer.until(lambda: states, "preview")
    commands = observer.publisher(Float64MultiArray, f"{NODE}/commands")
    commands.publish(Float64MultiArray(data=[0.0, 0.0, 0.0]))
    said = observer.told("phase", "finished")
    if speed:
        assert 1.5 < float(said["real_time_factor"]) <= speed
    else:  # no tick waits, none can be late
        assert (float(said["late_max_us"]), said["ticks_missed"]) == (0.0, "0")

    def stamps():
        return [observer.stamp(state) for state in states if observer.stamp(state)]

    observer.until(lambda: len(stamps()) >= 201, "the 201 samples")
    assert stamps() == [stamps()[0] + 10_000_000 * k for k in range(201)]
    assert process.wait(timeout=10) == 0


def test_a_clock_is_given_and_a_second_one_refused(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    clocks = observer.listen(Clock, "/clock")
    nodes.run("simulator", publish_clock=True)
    observer.until(lambda: len(clocks) > 20 and len(states) > 20, "time")
    times = [message.clock.sec * 10**9 + message.clock.nanosec for message in clocks]
    assert times == sorted(times) and times[0] > 0
    assert {observer.stamp(state) for state in states[-5:]} <= set(times)
    assert observer.call(SetBool, f"{NODE}/pause", data=True).success
    observer.until(lambda: clocks[-1] == clocks[-2], "the time of the pause, repeated")
    (info,) = observer.node.get_publishers_info_by_topic("/clock")
    assert info.qos_profile.depth in (0, 1)  # DDS does not tell it everywhere

    second = nodes.start(
        "simulator", "--ros-args", "-r", "__node:=other", "-p", "publish_clock:=true"
    )
    _, err = second.communicate(timeout=20)
    assert second.returncode == 1
    assert "/clock is published already, by /sst_simulator" in err and "Traceback" not in err


@pytest.mark.slow
def test_a_rival_that_comes_later_is_told(nodes, observer):
    nodes.run("simulator", publish_clock=True)
    observer.told("phase", "running")
    observer.node.create_publisher(Clock, "/clock", 1)
    observer.until(
        lambda: (
            "/clock is also published by /observer"
            in observer.heard["/diagnostics"][-1].status[0].message
        ),
        "the warning",
    )


def test_a_clock_is_followed_through_pause_jump_and_return(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    nodes.run("simulator", use_sim_time=True)
    publisher = observer.publisher(Clock, "/clock")
    observer.until(lambda: states, "preview")
    assert observer.stamp(states[-1]) == 0  # no time, no run
    at = [100 * 10**9]

    def stamps():
        return [observer.stamp(state) for state in states if observer.stamp(state)]

    def goes(step):
        def condition():
            at[0] += step
            publisher.publish(clock(at[0]))
            observer.executor.spin_once(timeout_sec=0.002)
            return len(stamps()) > goes.wanted

        return condition

    goes.wanted = 50
    observer.until(goes(10_000_000), "samples by the clock")
    assert 0 <= stamps()[0] - 100 * 10**9 < 10**9
    assert stamps()[-1] <= at[0]
    observer.told("ticks_missed", 0)

    publisher.publish(clock(at[0]))  # the clock stands still, and so do the ticks
    heard = observer.heard["/diagnostics"]

    def value(message, key):
        return next(pair.value for pair in message.status[0].values if pair.key == key)

    count = len(heard)
    observer.until(
        lambda: len(heard) > count + 1 and value(heard[-1], "ticks") == value(heard[-2], "ticks"),
        "a standstill",
    )
    settled = value(heard[-1], "ticks")

    at[0] += 3600 * 10**9  # a leap: dropped, no burst
    observer.publish_until(  # /clock is best effort
        publisher,
        clock(at[0]),
        lambda: int(value(heard[-1], "ticks_missed")) > 3_000_000,
        "the dropped ticks",
    )
    assert int(observer.told("ticks", lambda n: True)["ticks"]) < int(settled) + 1000

    at[0] -= 1800 * 10**9  # back: stamps never are
    goes.wanted = len(stamps()) + 20
    observer.until(goes(10_000_000), "samples after the return")
    assert observer.told("clock_jumps", 1)["fault"] == ""
    assert stamps() == sorted(set(stamps()))
