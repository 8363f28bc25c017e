# SPDX-License-Identifier: Apache-2.0
"""Nodes that answer joint states hear two topics, whose messages come in any order.

The workers are called here as their executor calls them; no time passes.
"""

import itertools
from types import SimpleNamespace

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from ros.conftest import NAMES
from sensor_msgs.msg import JointState
from slow_cases import slow_except
from std_msgs.msg import String

from sst_ros.errors import SstError
from sst_ros.nodes.inverse_dynamics import InverseDynamicsController
from sst_ros.nodes.process import Worker
from sst_ros.nodes.torque_player import TorquePlayer
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.scene import scene
from sst_ros.state import IDLE_FRAME_ID

pytestmark = pytest.mark.ros
START = scene.load("reach").initial.gamma  # also that of example2, which is played
FAULT = "fault: stopped at t = 0.1 s"
GRIPPER = JointState(name=["finger"], position=[0.0], velocity=[0.0], effort=[0.0])
GRIPPER.header.stamp.sec = 7


def state(nanosec, frame_id=""):
    message = JointState(name=list(NAMES), position=list(START), velocity=[0.0] * 3)
    message.header.stamp.nanosec, message.header.frame_id = nanosec, frame_id
    return message


STATES = [
    state(1_000_000, IDLE_FRAME_ID),
    state(2_000_000),
    state(4_000_000),
    state(5_000_000, IDLE_FRAME_ID),  # held in the fault
]
PHASES = [String(data=phase) for phase in ("waiting", "running", FAULT)]


def merges(first, second):
    """Every order in which the messages of two topics can come."""
    count = len(first) + len(second)
    for places in itertools.combinations(range(count), len(first)):
        one, other = iter(first), iter(second)
        yield [next(one) if place in places else next(other) for place in range(count)]


def orders(phases, states):
    """Every order of the two topics, each of which may be discovered late."""
    for late in range(len(phases)):
        for later in range(len(states)):
            yield from merges(phases[late:], states[later:])


@pytest.fixture(scope="module")
def ros(domain_of_module):
    rclpy.init()
    yield
    rclpy.try_shutdown()


class Commands:
    """Keeps the commands that a worker publishes, to one subscriber."""

    def __init__(self):
        self.sent, self.topic_name = [], "commands"

    def publish(self, message):
        torques = message.effort if isinstance(message, JointState) else message.data
        self.sent.append(list(torques))

    def get_subscription_count(self):
        return 1


@pytest.fixture
def make(ros):
    """Make workers without an executor, whose commands have a subscriber."""
    made = []

    def worker(kind):
        made.append(kind())
        made[-1]._commands = Commands()
        return made[-1]

    yield worker
    for one in made:
        one.node.destroy_node()
        if isinstance(one, InverseDynamicsController):
            one.follower.close()


ONE_QUICK_KIND = slow_except(
    [TorquePlayer],
    [TorquePlayer, InverseDynamicsController],
    mark=pytest.mark.breadth,
)


def give(worker, message):
    """Call back as the executor does."""
    (worker.hear if isinstance(message, String) else worker.receive)(message)


def look(worker, times):
    """Look for silence as the timer does."""
    for _ in range(times):
        worker.watch()


@pytest.mark.parametrize("kind", ONE_QUICK_KIND)
def test_a_fault_ends_who_commands_in_every_order_of_messages(make, kind):
    for messages in orders(PHASES, STATES):
        worker = make(kind)
        with pytest.raises(SstError, match="the simulator stopped: fault: stopped at"):
            for message in messages:
                give(worker, message)
        worker.close()
        assert not worker._commands.sent or not any(worker._commands.sent[-1])
        worker.node.destroy_node()


@pytest.mark.parametrize("kind", [TorquePlayer, InverseDynamicsController])
def test_a_fault_is_no_concern_of_who_has_not_commanded(make, kind):
    """A simulator may be in a fault, and be reset, before it has anybody to answer."""
    worker = make(kind)
    for phase in (FAULT, "waiting"):
        worker.hear(String(data=phase))
    worker.receive(STATES[0])
    assert len(worker._commands.sent) == 1


@pytest.mark.parametrize("kind", ONE_QUICK_KIND)
def test_the_end_of_the_run_ends_who_commands_in_every_order(make, kind):
    """Answers that are still to be given are given first: the node looks later."""
    for messages in orders([*PHASES[:2], String(data="finished")], STATES[:3]):
        worker = make(kind)
        for message in messages:
            give(worker, message)
        worker.watch()
        assert worker.done.is_set(), [
            getattr(message, "data", "state") for message in messages
        ]
        worker.node.destroy_node()


@pytest.mark.parametrize("kind", [TorquePlayer, InverseDynamicsController])
def test_joint_states_of_another_robot_are_no_sign_of_life(make, kind):
    """They are neither answered nor counted as samples; the time-out names them."""
    quiet, disturbed = make(kind), make(kind)
    for message in STATES[:3]:
        give(quiet, message)
        for heard in (GRIPPER, message, GRIPPER):
            give(disturbed, heard)
    assert disturbed._commands.sent == quiet._commands.sent
    assert len(quiet._commands.sent) == 3
    assert disturbed.foreign_states == 6
    give(disturbed, GRIPPER)
    with pytest.raises(
        SstError, match=r"no joint_states for 10\.2 s: .*7 messages without gamma_1"
    ):
        look(disturbed, 42)


@pytest.mark.parametrize("kind", [TorquePlayer, InverseDynamicsController])
def test_silence_is_counted_in_looks_and_ends_with_a_state(make, kind):
    """A node that is stopped for a minute looks once when it goes on, then reads."""
    worker = make(kind)
    for message in STATES[:3]:
        give(worker, message)
        look(worker, 41)
    with pytest.raises(SstError, match=r"no joint_states for 10\.2 s"):
        worker.watch()


def test_the_result_of_a_goal_has_the_reason_of_the_end(make):
    """Of a goal that is aborted because the node ends."""
    worker, reasons = make(InverseDynamicsController), []
    goal = SimpleNamespace(handle=SimpleNamespace(is_cancel_requested=False))
    worker._active, worker.failure = goal, SstError("no joint_states for 10.0 s")
    executor = SingleThreadedExecutor()
    executor.add_node(worker.node)
    worker._interrupt = reasons.append
    worker.close()
    assert reasons == ["the controller ends: no joint_states for 10.0 s"]


def test_a_refused_parameter_is_named_with_its_node(ros):
    worker = Worker("sst_simulator", SimulatorParameters)
    (result,) = worker.node.set_parameters([Parameter("real_time_factor", value=1e-9)])
    worker.node.destroy_node()
    assert (
        result.reason
        == "/sst_simulator: real_time_factor = 1e-09: must be 0 or >= 0.001"
    )


@pytest.mark.parametrize("kind", [TorquePlayer, InverseDynamicsController])
def test_a_part_of_the_actuators_is_refused_by_name(make, kind):
    worker = make(kind)
    with pytest.raises(
        SstError, match=r"joint_states has no gamma_2, gamma_3.*'gamma_1', 'mu_1'"
    ):
        give(
            worker,
            JointState(
                name=["gamma_1", "mu_1"], position=[0.0] * 2, velocity=[0.0] * 2
            ),
        )
