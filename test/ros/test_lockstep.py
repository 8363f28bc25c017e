# SPDX-License-Identifier: Apache-2.0
"""Lockstep: a closed loop gives the same bits on an idle and on a loaded machine."""

import ast
import contextlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import qos_profile_sensor_data
from ros.conftest import STAMPED, Observer, named
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from slow_cases import slow_except

from sst_ros import Simulation, load_scene, simulate
from sst_ros.recording import recording
from sst_ros.state import IDLE_FRAME_ID, Joints, nanoseconds

pytestmark = pytest.mark.ros
AT_ONCE = {"sync": "lockstep", "real_time_factor": 0.0}
PERIOD_NS = 2_000_000
EXAMPLE = Path(__file__).parents[2] / "examples" / "controller.py"
GOAL = ast.literal_eval(
    re.search(r"^GOAL = (\(.*?\))", EXAMPLE.read_text(), re.MULTILINE)[1]
)


def pd_torque(gamma, gamma_dot):
    goal = np.array([0.9, 0.7, 0.8])
    return (60.0 * (goal - np.array(gamma)) - 6.0 * np.array(gamma_dot)).tolist()


@pytest.mark.parametrize("loaded", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_simulate_and_the_bag_of_nodes_have_the_same_bits(
    nodes, observer, tmp_path, loaded
):
    """One closed loop, PD on gamma: nodes answer every sample by its stamp.

    Then in one call.

    In test_simulate.py the call has the bits of single steps.
    """
    recorder = nodes.run("recorder", output=tmp_path / "bag")
    rates = {"rate": 500, "publish_rate": 500}
    simulator = nodes.run("simulator", duration=0.3, **rates, **AT_ONCE)
    assert nodes.line(recorder).startswith("ready")
    # all processors are busy until the end of the test
    for _ in range(3 if loaded else 0):
        nodes.start("", executable=[sys.executable, "-c", "while True: pass"])
    publisher = observer.node.create_publisher(JointState, STAMPED, 10)

    def answer(state):
        torque = pd_torque(state.position[:3], state.velocity[:3])
        publisher.publish(named(torque, state.header.stamp))

    observer.node.create_subscription(JointState, "/joint_states", answer, 10)
    observer.until(
        lambda: simulator.poll() is not None, "end of the run", timeout=100.0
    )
    assert simulator.returncode == 0
    assert nodes.stop(recorder)[0] == 0
    recorded = recording.read(tmp_path / "bag")
    bag = recorded.trajectory
    whole = simulate(
        bag.scene,
        lambda t, state: pd_torque(state.joints.gamma, state.joints.gamma_dot),
        0.3,
        control_period=PERIOD_NS / 1e9,
        tolerance=1e-10,
    )
    assert len(bag) == len(whole) == 151
    assert np.ptp(bag.gamma, axis=0).min() > 1e-3  # it moves
    assert recorded.ticks.gaps == 0
    assert np.array_equal(recorded.ticks.torque, bag.torque[1:])
    assert np.array_equal(recorded.ticks.end_ns, recorded.time_ns[1:])
    for name in (*Joints._fields, "quaternion", "torque", "t"):
        assert np.array_equal(getattr(bag, name), getattr(whole, name)), name
    # The bag has no body rate: it is computed from the rates of the joints.
    np.testing.assert_allclose(bag.body_rate, whole.body_rate, atol=1e-12)
    assert bag.error_estimate == pytest.approx(whole.error_estimate, rel=1e-2)


class ControllerManager:
    """Stands in for a controller manager with use_sim_time whose hardware is hardware/.

    It is updated where /clock is a period or more after the update before, by the joint
    state of that time, however late that comes, and answers it; before the run from the
    update `begins` on.
    """

    def __init__(self, node, period_ns, begins):
        self.period_ns, self.begins = period_ns, begins
        self.now_ns, self.answered = 0, 0
        self.states, self.updates = [], []
        self.publisher = node.create_publisher(JointState, STAMPED, 10)
        node.create_subscription(Clock, "/clock", self.tick, qos_profile_sensor_data)
        node.create_subscription(JointState, "/joint_states", self.read, 10)

    def tick(self, message):
        self.now_ns = nanoseconds(message.clock)
        self.update()

    def read(self, state):
        self.states.append(state)
        self.update()

    def update(self):
        last_ns = self.updates[-1] if self.updates else 0
        is_due = self.now_ns - last_ns >= self.period_ns
        if not (is_due and self.states):
            return
        state = self.states[-1]
        if nanoseconds(state.header.stamp) != self.now_ns:
            return
        self.updates.append(self.now_ns)
        if len(self.updates) > self.begins:
            # By the count of updates too: one more or less would give other bits.
            torque = [0.02 * self.answered - 6.0 * rate for rate in state.velocity[:3]]
            self.answered += state.header.frame_id != IDLE_FRAME_ID
            self.publisher.publish(named(torque, state.header.stamp))


@pytest.mark.parametrize(
    "rate", slow_except([500], [100, 500], mark=pytest.mark.breadth)
)
def test_a_controller_manager_updates_once_for_each_sample(nodes, domain, rate):
    """The same bits whether its controller is there at once or later."""
    count = int(0.2 * rate) + 1
    rates = {"rate": 500, "publish_rate": rate, "duration": 0.2}
    runs = []
    for begins in (0, 3):
        with contextlib.closing(Observer(domain)) as observer:
            manager = ControllerManager(observer.node, 10**9 // rate, begins)
            simulator = nodes.run("simulator", publish_clock=True, **rates, **AT_ONCE)
            observer.until(
                lambda heard=manager: heard.answered == count, "end of the run", 100.0
            )
            assert nodes.ended(simulator)[0] == 0
        samples = [state for state in manager.states if Observer.stamp(state)]
        assert manager.updates[-count:] == [*map(Observer.stamp, samples)]
        assert len(manager.updates) > count + begins
        assert set(np.diff(manager.updates)) == {10**9 // rate}
        runs.append(
            [(*state.position, *state.velocity, *state.effort) for state in samples]
        )
    assert runs[0] == runs[1]
    assert np.ptp(runs[0], axis=0)[:3].min() > 1e-3  # it moves


@pytest.mark.parametrize(
    "name", [pytest.param("example1", marks=pytest.mark.slow), "example2"]
)
def test_an_example_runs_by_the_equations_of_the_paper(nodes, observer, name):
    """The same samples as by the default equations."""
    given = {"scene": name, "equations": "virtual_work", "duration": 0.05}
    simulator = nodes.run("simulator", **given, **AT_ONCE)
    observer.preview()
    nodes.run("torque_player", scene=name)
    observer.until(lambda: len(observer.samples()) >= 26, "samples")
    samples = observer.samples()
    assert nodes.ended(simulator)[0] == 0 and len(samples) == 26
    simulation, profile = Simulation(name), load_scene(name).torque.at
    for k, sample in enumerate(samples):
        joints = simulation.state.joints
        expected = [*joints.gamma, *joints.mu, *joints.beta]
        np.testing.assert_allclose(sample.position[:9], expected, rtol=0.0, atol=1e-12)
        simulation.steps(profile((k + 0.5) * PERIOD_NS / 1e9), PERIOD_NS // 2, 2)


@pytest.mark.parametrize(
    "sync", slow_except(["free"], ["free", "lockstep"], mark=pytest.mark.breadth)
)
def test_the_example_of_a_controller_reaches_its_goal(nodes, observer, sync):
    nodes.start("", executable=[sys.executable, str(EXAMPLE)])
    nodes.run("simulator", scene="example2", sync=sync, wait_for_command=True)
    at_goal = pytest.approx(GOAL, abs=0.02)
    observer.until(
        lambda: observer.states and observer.states[-1].position[:3] == at_goal,
        "goal",
        90.0,
    )
