# SPDX-License-Identifier: Apache-2.0
"""simulation_interfaces 2.x with real types, a real client and a real simulator."""

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from ros.conftest import NODE, foreign_types, torques
from std_msgs.msg import Float64MultiArray

from sst_ros import load_scene
from sst_ros.mechanism import kinematics, rates
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.nodes.simulation_interfaces import FEATURES
from sst_ros.state import nanoseconds

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
SCENE = "gravity_payload"
UNSUPPORTED, OK, NOT_FOUND, FAILED, INVALID_POSE = 0, 1, 2, 4, 101
STOPPED, PLAYING, PAUSED, QUITTING, NO_WORLD = range(5)
ALREADY_THERE, INCORRECT_TRANSITION = 101, 103


class Client:
    """Calls the services of one simulator."""

    def __init__(self, nodes, observer, env):
        from simulation_interfaces import srv

        self.observer, self.srv, self.states = observer, srv, observer.states
        given = {"scene": SCENE, "duration": 0.0, "publish_rate": 100}
        given["base_frame"] = "left/base_link"
        self.process = nodes.start("simulator", env=env, **given)

    def call(self, kind, **fields):
        name = "".join(
            f"_{c.lower()}" if c.isupper() else c for c in kind
        ).removeprefix("_")
        return self.observer.call(getattr(self.srv, kind), f"{NODE}/{name}", **fields)

    def code(self, kind, **fields):
        """Code of the result, and its words."""
        result = self.call(kind, **fields).result
        return result.result, result.error_message

    def set(self, state, **which):
        return self.code("SetEntityState", entity="star", state=state, **which)

    def state(self):
        return self.call("GetSimulationState").state.state

    def to(self, state):
        from simulation_interfaces.msg import SimulationState

        return self.code("SetSimulationState", state=SimulationState(state=state))[0]


@pytest.fixture(scope="module")
def types():
    yield from foreign_types("simulation_interfaces")


@pytest.fixture(scope="module")
def client(types, nodes_of_module, observer_of_module):
    return Client(nodes_of_module, observer_of_module, types)


def test_features_states_and_scopes(client):
    features = client.call("GetSimulatorFeatures").features
    assert list(features.features) == list(FEATURES)
    client.observer.until(lambda: client.state() == PLAYING, "the run")
    assert client.code("StepSimulation", steps=1)[0] == FAILED
    assert (client.to(PAUSED), client.state(), client.to(PAUSED)) == (
        OK,
        PAUSED,
        ALREADY_THERE,
    )

    def reset(scope):
        return client.code("ResetSimulation", scope=scope)[0]

    assert (reset(1), client.state()) == (UNSUPPORTED, PAUSED)  # time is never reset
    assert (reset(2), client.state()) == (OK, STOPPED)
    assert (reset(3), reset(6), reset(255)) == (UNSUPPORTED, OK, OK)
    assert client.to(PAUSED) == INCORRECT_TRANSITION
    assert client.to(NO_WORLD) == UNSUPPORTED
    assert (client.to(PLAYING), client.state()) == (OK, PLAYING)
    assert (client.to(STOPPED), client.state()) == (OK, STOPPED)


def test_steps_by_count_and_by_the_action(client):
    from simulation_interfaces.action import SimulateSteps

    client.to(STOPPED)
    until, stamps = client.observer.until, client.observer.stamps
    before = len(set(stamps()))
    assert client.code("StepSimulation", steps=5)[0] == OK
    until(lambda: len(set(stamps())) >= before + 5, "five samples")
    action = ActionClient(client.observer.node, SimulateSteps, f"{NODE}/simulate_steps")
    until(action.server_is_ready, "the action server")
    feedback = []

    def send(steps):
        feedback.clear()
        goal = SimulateSteps.Goal(steps=steps)
        sent = action.send_goal_async(
            goal, lambda message: feedback.append(message.feedback)
        )
        return client.observer.result(sent, "the answer")

    def result(handle):
        done = client.observer.result(handle.get_result_async(), "the result")
        return done.status, done.result.result

    # The long one first: feedback from before the server has found its reader is lost.
    handle = send(10**9)
    until(lambda: len(feedback) > 3, "feedback")
    client.observer.result(handle.cancel_goal_async(), "the answer")
    assert result(handle)[0] == GoalStatus.STATUS_CANCELED
    handle = send(7)
    # Before the result is asked for: after it rclpy's client hears no feedback.
    until(lambda: len(feedback) >= 7, "feedback")
    status, reply = result(handle)
    assert (status, reply.result) == (GoalStatus.STATUS_SUCCEEDED, OK)
    counts = [
        (message.completed_steps, message.remaining_steps) for message in feedback
    ]
    assert counts == [(k, 7 - k) for k in range(1, 8)]
    client.to(PLAYING)
    status, reply = result(send(3))
    assert (status, reply.result) == (GoalStatus.STATUS_ABORTED, FAILED)
    assert "running" in reply.error_message


def test_an_entity_state_has_the_time_at_which_it_holds(client):
    """Between two samples of a run, on a step.

    Before it as joint_states, which is idle.
    """
    until, stamps = client.observer.until, client.observer.stamps

    def stamp():
        state = client.call("GetEntityState", entity="star").state
        (listed,) = client.call("GetEntitiesStates").states
        assert nanoseconds(listed.header.stamp) >= nanoseconds(state.header.stamp)
        return nanoseconds(state.header.stamp)

    client.to(STOPPED)
    before = stamp()
    assert before > max(stamps(), default=0)
    count = len(stamps())
    client.to(PLAYING)
    until(lambda: len(stamps()) > count, "a sample of the run")
    sample = stamps()[-1]
    at = stamp()
    assert sample <= at and (at - sample) % 1_000_000 == 0
    until(lambda: stamps()[-1] >= at, "a later sample")


def test_the_star_is_read_and_set_with_its_joints(client):
    from geometry_msgs.msg import Quaternion
    from simulation_interfaces.msg import EntityFilters, EntityState

    client.to(STOPPED)
    assert client.call("GetEntities").entities == ["star"]
    none = client.call("GetEntities", filters=EntityFilters(filter="^robot"))
    assert none.result.result == OK and not none.entities
    assert client.code("GetEntities", filters=EntityFilters(filter="("))[0] == FAILED
    assert client.code("GetEntityState", entity="arm")[0] == NOT_FOUND

    scene = load_scene(SCENE)
    geometry = Geometry.of(scene)
    gamma = np.add(scene.initial.gamma, (0.03, -0.02, 0.01))
    rotation = kinematics.admissible(geometry, gamma).rotation
    x, y, z, w = quaternion_of(rotation).tolist()
    state = EntityState()
    state.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    turning = (0.1, -0.2, 0.3)
    state.twist.angular.x, state.twist.angular.y, state.twist.angular.z = turning
    assert client.set(state, set_pose=True, set_twist=True) == (OK, "")
    client.observer.until(
        lambda: np.abs(np.subtract(client.states[-1].position[:3], gamma)).max() < 1e-9,
        "the state that was set",
    )
    found = client.call("GetEntityState", entity="star").state
    assert found.header.frame_id == "left/base_link"
    read = found.pose.orientation
    assert (
        np.abs(rotation_matrix((read.x, read.y, read.z, read.w)) - rotation).max()
        < 1e-9
    )
    assert (
        found.twist.angular.x,
        found.twist.angular.y,
        found.twist.angular.z,
    ) == pytest.approx(turning, abs=1e-9)
    expected = rates.of_star(geometry, rotation, turning).gamma_dot
    assert client.states[-1].velocity[:3] == pytest.approx(expected, abs=1e-7)
    listed = client.call("GetEntitiesStates")
    assert listed.entities == ["star"] and listed.states[0].pose == found.pose

    assert client.set(EntityState(), set_twist=True)[0] == OK
    client.observer.until(lambda: not any(client.states[-1].velocity), "rest")
    for bad in (
        Quaternion(w=0.5),
        Quaternion(x=1.0, w=0.0),
        Quaternion(x=float("nan")),
    ):
        wrong = EntityState()
        wrong.pose.orientation = bad
        code, words = client.set(wrong, set_pose=True)
        assert code == INVALID_POSE and words
    away = EntityState()
    away.pose.orientation, away.pose.position.z = state.pose.orientation, 0.1
    code, words = client.set(away, set_pose=True)
    assert code == INVALID_POSE and "position" in words
    client.to(PLAYING)
    code, words = client.set(state, set_pose=True)
    assert code == FAILED and "running" in words


def test_a_fault_is_no_pause(client):
    """There is no state for a fault.

    It is left by a stop or a reset, not by a start.
    """
    pull = client.observer.publisher(Float64MultiArray, f"{NODE}/commands")
    assert client.to(STOPPED) in (OK, ALREADY_THERE)
    assert client.to(PLAYING) == OK
    client.observer.publish_until(
        pull,
        torques(500.0, 0.0, 0.0),
        lambda: client.observer.phases[-1:] != ["running"],
        "fault",
    )
    client.observer.phase("fault")
    code, words = client.code("GetSimulationState")
    assert code == FAILED and words.startswith("fault: stopped at")
    for state in (PLAYING, PAUSED):
        assert client.to(state) == INCORRECT_TRANSITION
    assert (client.to(STOPPED), client.state()) == (OK, STOPPED)
    assert client.code("GetSimulationState") == (OK, "")


def test_spawning_is_refused_by_name_and_the_node_quits(client, nodes_of_module):
    code, words = client.code("SpawnEntity", name="table")
    assert code == UNSUPPORTED and "table is not spawned" in words
    assert client.to(QUITTING) == OK
    assert nodes_of_module.ended(client.process)[0] == 0
