# SPDX-License-Identifier: Apache-2.0
"""Lockstep: a closed loop gives the same bits on an idle and on a loaded machine."""

import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from sst_ros import Simulation, simulate
from sst_ros.recording import recording
from sst_ros.state import Joints

pytestmark = pytest.mark.ros
NODE = "/sst_simulator"
JOINTS = Joints._fields


def pd_torque(gamma, gamma_dot):
    goal = np.array([0.9, 0.7, 0.8])
    return (60.0 * (goal - np.array(gamma)) - 6.0 * np.array(gamma_dot)).tolist()


class Controller:
    """PD on gamma, answering every sample by its stamp."""

    def __init__(self, observer):
        self.publisher = observer.node.create_publisher(JointState, f"{NODE}/commands_stamped", 10)
        self.node = observer.node
        self.states = self.node.create_subscription(JointState, "/joint_states", self.answer, 10)

    def close(self):
        self.node.destroy_subscription(self.states)
        self.node.destroy_publisher(self.publisher)

    def answer(self, state):
        effort = pd_torque(state.position[:3], state.velocity[:3])
        answer = JointState(name=state.name[:3], effort=effort)
        answer.header.stamp = state.header.stamp
        self.publisher.publish(answer)


def closed_loop(nodes, observer, bag, disturb=lambda: None, **options):
    recorder = nodes.run("recorder", output=bag)
    simulator = nodes.run(
        "simulator",
        sync="lockstep",
        duration=0.3,
        real_time_factor=0.0,
        publish_rate=500,
        **options,
    )
    assert nodes.line(recorder).startswith("ready")
    disturb()
    controller = Controller(observer)
    observer.until(lambda: simulator.poll() is not None, "end of the run", timeout=60.0)
    controller.close()
    assert simulator.returncode == 0
    assert nodes.stop(recorder)[0] == 0
    return recording.read(bag)


@pytest.fixture
def load():
    """Keep all processors busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    yield busy
    for process in busy:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_closed_loop_is_the_same_on_a_loaded_machine(nodes, observer, tmp_path, request):
    idle = closed_loop(nodes, observer, tmp_path / "idle")
    disturb = partial(request.getfixturevalue, "load")
    loaded = closed_loop(nodes, observer, tmp_path / "loaded", disturb)
    assert len(idle.time_ns) == 151 and idle.ticks.gaps == 0
    assert np.ptp(idle.gamma, axis=0).min() > 1e-3  # it moves
    for name in (
        *("time_ns", "gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot"),
        *("effort", "quaternion", "euler"),
    ):
        assert np.array_equal(getattr(idle, name), getattr(loaded, name)), name
    assert np.array_equal(idle.ticks.torque, loaded.ticks.torque)
    assert np.array_equal(idle.ticks.end_ns, loaded.ticks.end_ns)


def test_simulate_simulation_and_the_bag_of_nodes_have_the_same_bits(nodes, observer, tmp_path):
    """One closed loop three times: in one call, step by step, and as nodes in lockstep."""
    bag = closed_loop(nodes, observer, tmp_path / "bag", rate=500).trajectory
    tolerance, period = 1e-10, 0.002
    whole = simulate(
        bag.scene,
        lambda t, state: pd_torque(state.joints.gamma, state.joints.gamma_dot),
        0.3,
        control_period=period,
        tolerance=tolerance,
    )
    simulation = Simulation(bag.scene, tolerance=tolerance)
    states = [simulation.state]
    for _ in range(150):
        joints = simulation.state.joints
        torque = tuple(pd_torque(joints.gamma, joints.gamma_dot))
        states.append(simulation.step(torque, round(period * 1e9)))
    assert len(bag) == len(whole) == len(states) == 151
    assert np.ptp(bag.gamma, axis=0).min() > 1e-3
    single = {
        **{name: [getattr(state.joints, name) for state in states] for name in JOINTS},
        "t": [state.time_ns / 1e9 for state in states],
        "quaternion": [state.quaternion for state in states],
        "torque": [state.torque for state in states],
    }
    for name, values in single.items():
        assert np.array_equal(getattr(whole, name), values), name
        assert np.array_equal(getattr(bag, name), values), name
    assert whole.body_rate.tolist() == [list(state.body_rate) for state in states]
    # The bag has no body rate: it is computed from the rates of the joints.
    np.testing.assert_allclose(bag.body_rate, whole.body_rate, atol=1e-12)
    assert bag.error_estimate == pytest.approx(whole.error_estimate, rel=1e-2)


def test_without_an_answer_it_stops_with_a_fault(nodes, observer):
    states = observer.listen(JointState, "/joint_states")
    process = nodes.run("simulator", sync="lockstep", lockstep_timeout=0.3)
    publisher = observer.publisher(JointState, f"{NODE}/commands_stamped")
    observer.until(lambda: states, "preview")
    answer = JointState(name=["gamma_1", "gamma_2", "gamma_3"], effort=[0.0] * 3)
    publisher.publish(answer)  # stamp zero: begins
    observer.until(lambda: any(observer.stamp(s) for s in states), "the first sample")
    first = next(state for state in states if observer.stamp(state))
    publisher.publish(answer)  # of the wrong stamp, not counted: answers to previews are harmless
    answer.header.stamp = first.header.stamp
    answer.header.stamp.nanosec ^= 1
    publisher.publish(answer)  # of a wrong stamp
    said = observer.told("phase", "fault")
    assert "no command answered the sample of" in said["fault"]
    assert said["commands_dropped_because"] == "stamp 1" and said["ticks"] == "0"
    status, _, err = nodes.stop(process, signal.SIGTERM)
    assert status == 0 and "Traceback" not in err


@pytest.mark.parametrize(("timeout", "factor"), [(1.5, 1.0), (3.0, 0.0)])
def test_the_timeout_counts_from_the_sample(nodes, observer, timeout, factor):
    """Longer than the period of the diagnostics, which wake the run."""
    states = observer.listen(JointState, "/joint_states")
    nodes.run(
        "simulator",
        sync="lockstep",
        lockstep_timeout=timeout,
        real_time_factor=factor,
        duration=0.0,
    )
    publisher = observer.publisher(JointState, f"{NODE}/commands_stamped")
    observer.until(lambda: states, "preview")
    begin = JointState(name=["gamma_1", "gamma_2", "gamma_3"], effort=[0.0] * 3)
    begin.header.stamp = states[-1].header.stamp
    publisher.publish(begin)
    observer.told("phase", "running")
    said = observer.told("phase", "fault", timeout + 3.0)
    assert f"within {timeout:g} s" in said["fault"]


@pytest.mark.slow
def test_the_player_plays_in_lockstep(nodes, observer, tmp_path):
    table = tmp_path / "torque.csv"
    table.write_text("time,tau_1,tau_2,tau_3\n0,0.1,0.2,0.3\n0.05,0.3,0.2,0.1\n0.1,0,0,0\n")
    states = observer.listen(JointState, "/joint_states")
    simulator = nodes.run("simulator", sync="lockstep", duration=0.1, real_time_factor=0.0)
    observer.until(lambda: states, "preview")
    player = nodes.run("torque_player", csv=table, stamped=True)
    observer.until(lambda: simulator.poll() is not None, "end of the run")
    assert (simulator.returncode, player.wait(timeout=10)) == (0, 0)
    run = [tuple(s.effort[:3]) for s in states if observer.stamp(s)]
    assert run == [(0.0,) * 3, *[(0.1, 0.2, 0.3)] * 25, *[(0.3, 0.2, 0.1)] * 25]
