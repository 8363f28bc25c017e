# SPDX-License-Identifier: Apache-2.0
"""Pause, step, reset and set_state of a real simulator."""

import math

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger

pytestmark = pytest.mark.ros
NODE = "/sst_simulator"
NAMES = ["gamma_1", "gamma_2", "gamma_3"]


def run_stamps(observer, states):
    return [observer.stamp(state) for state in states if observer.stamp(state)]


def test_pause_step_and_resume(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    phases = observer.listen(String, f"{NODE}/phase", latched=True)
    nodes.run("simulator", scene="example1", real_time_factor=0.1)
    observer.until(lambda: run_stamps(observer, states), "samples")
    refused = observer.call(Trigger, f"{NODE}/step")
    assert not refused.success and "running" in refused.message
    assert observer.call(SetBool, f"{NODE}/pause", data=True).success
    assert observer.call(SetBool, f"{NODE}/pause", data=True).message == "already paused"
    observer.until(lambda: phases[-1].data == "paused", "phase")
    observer.until(lambda: states and observer.stamp(states[-1]) == 0, "a shown state")
    assert any(states[-1].velocity)  # it is the state, not a stop
    before = run_stamps(observer, states)
    assert observer.call(Trigger, f"{NODE}/step").success
    observer.until(lambda: len(run_stamps(observer, states)) > len(before), "the step's sample")
    assert run_stamps(observer, states) == [*before, before[-1] + 2_000_000]
    assert observer.call(SetBool, f"{NODE}/pause", data=False).message == "running"
    observer.until(lambda: len(run_stamps(observer, states)) > len(before) + 5, "more samples")
    stamps = run_stamps(observer, states)
    assert stamps == [stamps[0] + 2_000_000 * k for k in range(len(stamps))]


def test_reset_set_state_and_what_is_refused(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    process = nodes.run("simulator", wait_for_command=True, command_timeout=0.0)
    put = observer.publisher(JointState, f"{NODE}/set_state")
    observer.until(lambda: states, "preview")
    start = list(states[-1].position)
    bad = [
        JointState(name=NAMES, position=[9.0, 0.7, 0.7]),  # outside the stroke
        JointState(name=NAMES[:2], position=[0.7, 0.7]),
        JointState(name=NAMES, position=[math.nan, 0.7, 0.7]),
        JointState(name=NAMES, position=[0.7, 0.7, 0.7], velocity=[1.0]),
    ]
    for message in bad:
        put.publish(message)
    put.publish(JointState(name=NAMES[::-1], position=[0.8, 0.7, 0.6], velocity=[0.0, 0.0, 0.1]))
    observer.until(lambda: abs(states[-1].position[0] - 0.6) < 1e-9, "the state that was set")
    assert list(states[-1].position[:3]) == pytest.approx([0.6, 0.7, 0.8], abs=1e-9)
    assert list(states[-1].velocity[:3]) == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)

    commands = observer.publisher(Float64MultiArray, f"{NODE}/commands")
    commands.publish(Float64MultiArray(data=[0.1, 0.0, 0.0]))
    observer.until(lambda: run_stamps(observer, states), "samples")
    put.publish(JointState(name=NAMES, position=[0.7, 0.7, 0.7]))  # refused: it runs
    last = run_stamps(observer, states)[-1]
    reply = observer.call(Trigger, f"{NODE}/reset")
    assert (reply.success, reply.message) == (True, "at the initial state, waiting")
    observer.until(lambda: observer.stamp(states[-1]) == 0, "preview")
    assert list(states[-1].position) == start
    commands.publish(Float64MultiArray(data=[0.0, 0.0, 0.0]))
    observer.until(lambda: observer.stamp(states[-1]) > last, "samples after the reset")
    stamps = run_stamps(observer, states)
    assert stamps == sorted(set(stamps))
    said = observer.told("resets", 1)
    assert said["states_set"] == "1"
    _, _, err = nodes.stop(process)
    assert err.count("set_state refused: ") + err.count("set_state: refused: ") == 5


def test_a_fault_is_held_still_until_a_reset(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    phases = observer.listen(String, f"{NODE}/phase", latched=True)
    process = nodes.run("simulator", scene="example2_heavy")
    commands = observer.publisher(Float64MultiArray, f"{NODE}/commands")
    commands.publish(Float64MultiArray(data=[50.0, 0.0, 0.0]))
    observer.until(lambda: phases and phases[-1].data.startswith("fault: "), "fault")
    observer.until(lambda: observer.stamp(states[-1]) == 0, "the held state")
    sample = next(state for state in reversed(states) if observer.stamp(state))
    assert list(states[-1].position) == list(sample.position)
    assert 1.5 < sample.position[0] <= math.pi / 2
    assert any(sample.velocity) and not any(states[-1].velocity) and not any(states[-1].effort)
    said = observer.told("phase", "fault")
    assert said["level"] == b"\x02" and "gamma_1 > 1.570796 rad" in said["fault"]
    assert not observer.call(SetBool, f"{NODE}/pause", data=False).success
    assert observer.call(Trigger, f"{NODE}/reset").success
    last = observer.stamp(sample)
    observer.until(lambda: observer.stamp(states[-1]) > last, "samples after the reset")
    observer.told("fault", "")
    assert all(math.isfinite(x) for state in states for x in (*state.position, *state.velocity))
    status, _, err = nodes.stop(process)
    assert status == 0 and "Traceback" not in err and "held until ~/reset" in err
    assert "gamma_1 > 1.570796 rad" in err
