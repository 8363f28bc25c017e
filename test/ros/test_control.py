# SPDX-License-Identifier: Apache-2.0
"""Pause, step, reset and set_state of a real simulator."""

import math

import pytest
from rcl_interfaces.msg import Log
from ros.conftest import NAMES, NODE
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

pytestmark = pytest.mark.ros


def test_pause_step_and_resume(nodes, observer):
    """Over the services; test_run_loop.py has the state machine itself."""
    # A tick a sample: where a busy machine ends the wait within one, that is a sample, too.
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
    stamps = observer.stamps()
    assert stamps == [stamps[0] + 2_000_000 * k for k in range(len(stamps))]


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
    put.publish(JointState(name=NAMES[::-1], position=[0.8, 0.7, 0.6], velocity=[0.0, 0.0, 0.1]))
    observer.until(lambda: abs(observer.states[-1].position[0] - 0.6) < 1e-9, "the new state")
    shown = observer.states[-1]
    assert list(shown.position[:3]) == pytest.approx([0.6, 0.7, 0.8], abs=1e-9)
    assert list(shown.velocity[:3]) == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)

    observer.command(0.1, 0.0, 0.0)
    observer.until(observer.samples, "samples")
    put.publish(JointState(name=NAMES, position=[0.7, 0.7, 0.7]))  # refused: it runs
    running = "set_state: refused: pause or reset first"
    observer.until(lambda: any(log.msg.startswith(running) for log in logged), "the refusal")
    last = observer.stamps()[-1]
    reply = observer.call(Trigger, f"{NODE}/reset")
    assert (reply.success, reply.message) == (True, "at the initial state, waiting")
    observer.until(lambda: observer.stamp(observer.states[-1]) == 0, "preview")
    assert list(observer.states[-1].position) == start
    observer.command(0.0, 0.0, 0.0)
    observer.until(lambda: observer.stamp(observer.states[-1]) > last, "samples after the reset")
    stamps = observer.stamps()
    assert stamps == sorted(set(stamps))
    assert observer.told("resets", 1)["states_set"] == "1"
    _, _, err = nodes.stop(process)
    assert err.count("set_state refused: ") + err.count("set_state: refused: ") == 5
