# SPDX-License-Identifier: Apache-2.0
"""Pause, step, reset and set_state of a real simulator.

Its speed, /clock given and followed.
"""

import math
import re

import pytest
from rcl_interfaces.msg import Log, SetParametersResult
from ros.conftest import NAMES, NODE
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from sst_ros.state import nanoseconds

pytestmark = pytest.mark.ros


def test_pause_step_and_resume(nodes, observer):
    """Over the services; test_run_loop.py has the state machine itself."""
    # A tick a sample: where a busy machine ends the wait within one, that is a sample,
    # too.
    rates = {"rate": 500, "publish_rate": 500, "real_time_factor": 0.1}
    nodes.run("simulator", scene="example1", **rates)
    observer.until(observer.samples, "samples")
    assert "running" in observer.call(Trigger, f"{NODE}/step").message
    assert observer.pause(True).success
    observer.phase("paused")
    observer.until(lambda: observer.stamp(observer.states[-1]) == 0, "a shown state")
    assert any(observer.states[-1].velocity)  # it is the state, not a stop
    before = observer.stamps()
    assert observer.call(Trigger, f"{NODE}/step").success
    observer.until(lambda: len(observer.stamps()) > len(before), "the step's sample")
    assert observer.stamps() == [*before, before[-1] + 2_000_000]
    assert observer.pause(False).message == "running"
    observer.until(lambda: len(observer.stamps()) > len(before) + 5, "more samples")


def test_reset_set_state_and_what_is_refused(nodes, observer):
    logged = observer.listen(Log, "/rosout")
    process = nodes.run("simulator", wait_for_command=True, command_timeout=0.0)
    put = observer.publisher(JointState, f"{NODE}/set_state")
    start = list(observer.preview().position)
    for bad in (
        JointState(name=NAMES, position=[9.0, 0.7, 0.7]),  # outside the stroke
        JointState(name=NAMES[:2], position=[0.7, 0.7]),
        JointState(name=NAMES, position=[math.nan, 0.7, 0.7]),
        JointState(name=NAMES, position=[0.7, 0.7, 0.7], velocity=[1.0]),
    ):
        put.publish(bad)
    put.publish(
        JointState(name=NAMES[::-1], position=[0.8, 0.7, 0.6], velocity=[0.0, 0.0, 0.1])
    )
    observer.until(
        lambda: abs(observer.states[-1].position[0] - 0.6) < 1e-9, "the new state"
    )
    shown = observer.states[-1]
    assert list(shown.position[:3]) == pytest.approx([0.6, 0.7, 0.8], abs=1e-9)
    assert list(shown.velocity[:3]) == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)

    observer.command(0.1, 0.0, 0.0)
    observer.until(observer.samples, "samples")
    put.publish(JointState(name=NAMES, position=[0.7, 0.7, 0.7]))  # refused: it runs
    running = "set_state: refused: pause or reset first"
    observer.until(
        lambda: any(log.msg.startswith(running) for log in logged), "the refusal"
    )
    reply = observer.call(Trigger, f"{NODE}/reset")
    assert (reply.success, reply.message) == (True, "at the initial state, waiting")
    observer.until(lambda: observer.stamp(observer.states[-1]) == 0, "preview")
    assert list(observer.states[-1].position) == start
    assert observer.told("resets", 1)["states_set"] == "1"
    _, _, err = nodes.stop(process)
    assert err.count("set_state refused: ") + err.count("set_state: refused: ") == 5


def test_set_state_answers(nodes, observer):
    nodes.run("simulator", wait_for_command=True, command_timeout=0.0)
    name = f"{NODE}/set_state"

    def replies(**values):
        for parameter, value in values.items():
            assert observer.set_parameter(parameter, value) == SetParametersResult(
                successful=True
            )
        reply = observer.call(Trigger, name)
        return reply.success, reply.message

    start = list(observer.preview().position)
    assert replies() == (True, "the state is set, waiting")  # by default the scene's
    gamma, gamma_dot = [0.6, 0.7, 0.8], [0.1, 0.0, -0.2]
    assert replies(state_gamma=gamma, state_gamma_dot=gamma_dot)[0]
    observer.until(lambda: list(observer.states[-1].position) != start, "the state")
    shown = observer.states[-1]
    assert list(shown.position[:3]) == pytest.approx(gamma, abs=1e-9)
    assert list(shown.velocity[:3]) == pytest.approx(gamma_dot, abs=1e-9)
    success, reason = replies(state_gamma=[3.0, 0.7, 0.7])  # outside the stroke
    assert not success and reason.startswith("refused: ") and "gamma" in reason
    for bad in ([9.0, 0.7, 0.7], [0.7, 0.7], [0.7, math.nan, 0.7], [], ["a"], 0.7):
        refused = observer.set_parameter("state_gamma", bad)
        assert not refused.successful and refused.reason, bad
    assert replies(state_gamma=gamma)[0]
    observer.command(0.1, 0.0, 0.0)
    observer.until(observer.samples, "samples")
    success, reason = replies()
    assert not success and reason.startswith("refused: pause or reset first")
    assert observer.told("states_set", 3)


def clock(time_ns):
    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(time_ns, 10**9)
    return message


@pytest.mark.breadth
def test_a_run_as_fast_as_possible_loses_no_sample(nodes, observer):
    # by this process before the run, which is short
    heard = "[joint_states, /diagnostics]"
    given = {"duration": 2.0, "publish_rate": 100, "wait_for_subscribers": heard}
    observer.listen(JointState, "/joint_states")
    process = nodes.run("simulator", real_time_factor=0.0, **given)
    said = observer.told("phase", "finished")
    # No tick waits, none can be late.
    assert (float(said["late_max_us"]), said["ticks_missed"]) == (0.0, "0")
    observer.until(lambda: len(observer.stamps()) >= 201, "the 201 samples")
    stamps = observer.stamps()
    assert stamps == [stamps[0] + 10_000_000 * k for k in range(201)]
    assert nodes.ended(process)[0] == 0


def test_a_clock_is_given_and_a_second_one_told(nodes, observer):
    clocks = observer.listen(Clock, "/clock")

    def times():
        return [nanoseconds(message.clock) for message in clocks]

    # Not each: a reader that was held up finds the last time only.
    nodes.run("simulator", publish_clock=True)
    observer.until(
        lambda: len({*times()} & {*observer.stamps()}) > 20, "the time of the states"
    )
    assert times() == sorted(times()) and times()[0] > 0
    assert observer.pause(True).success
    observer.until(lambda: clocks[-1] == clocks[-2], "the time of the pause, repeated")
    (info,) = observer.node.get_publishers_info_by_topic("/clock")
    assert info.qos_profile.depth in (0, 1)  # DDS does not tell it everywhere

    observer.node.create_publisher(Clock, "/clock", 1)
    observer.told("said", lambda said: "/clock is also published by /observer" in said)


def test_a_clock_is_followed_through_pause_jump_and_return(nodes, observer):
    process = nodes.run("simulator", use_sim_time=True)
    publisher = observer.publisher(Clock, "/clock")
    assert observer.stamp(observer.preview()) == 0  # no time, no run
    at = [100 * 10**9]

    def run(samples, what):
        """Publish time, 10 ms further each time, until so many samples more."""
        begin, before = at[0], len(observer.stamps())

        def condition():
            new = len(observer.stamps()) - before
            # A busy simulator is waited for: from 200 ms on it would drop the time.
            if at[0] - begin - 2_000_000 * new < 100_000_000:
                at[0] += 10_000_000
            publisher.publish(clock(at[0]))
            observer.executor.spin_once(timeout_sec=0.002)
            return new > samples

        observer.until(condition, what)

    run(50, "samples by the clock")
    stamps = observer.stamps()
    assert 0 <= stamps[0] - 100 * 10**9 < 10**9
    assert stamps[-1] <= at[0]
    observer.told("ticks_missed", 0)

    publisher.publish(clock(at[0]))  # the clock stands still, and so do the ticks
    count = len(observer.said("ticks"))

    def stands():
        _, *told = observer.said("ticks")[count - 1 :]
        return len(told) > 1 and told[-1] == told[-2]

    observer.until(stands, "a standstill")
    said = observer.told(
        "said", lambda said: "/clock stands still: the run waits for it" in said
    )
    assert said["level"] == b"\x01"
    settled = int(observer.said("ticks")[-1])

    at[0] += 3600 * 10**9  # a leap: dropped, no burst
    observer.publish_until(  # /clock is best effort
        publisher,
        clock(at[0]),
        lambda: int(observer.said("ticks_missed")[-1]) > 3_000_000,
        "the dropped ticks",
    )
    assert int(observer.said("ticks")[-1]) < settled + 1000

    at[0] -= 1800 * 10**9  # back: stamps never are
    run(20, "samples after the return")
    assert observer.told("clock_jumps", 1)["fault"] == ""
    # A time of `run` comes first, 10 ms further.
    text = re.compile(r"/clock jumped back by 1799\.\d+ s; stamps of the run go on")
    back = [said for said in observer.diagnostics() if text.search(said["said"])]
    assert [said["level"] for said in back] == [b"\x01"]
    _, _, err = nodes.stop(process)
    assert len(text.findall(err)) == 1
    assert "/clock stands still: the run waits for it" in err
    assert observer.stamps() == sorted(set(observer.stamps()))
