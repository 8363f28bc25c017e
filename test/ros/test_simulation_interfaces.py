# SPDX-License-Identifier: Apache-2.0
"""simulation_interfaces 2.x with real types, a real client and a real simulator."""

import os
from functools import partial

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState

from sst_ros import load_scene
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Geometry
from sst_ros.nodes.simulation_interfaces import FEATURES

from . import message_types
from .conftest import Nodes, Observer

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
NODE = "/sst_simulator"
SCENE = "gravity_payload"
UNSUPPORTED, OK, NOT_FOUND, FAILED, INVALID_POSE = 0, 1, 2, 4, 101
STOPPED, PLAYING, PAUSED, QUITTING = range(4)


class Client:
    """Calls the services of one simulator."""

    def __init__(self, nodes, observer, env):
        from simulation_interfaces import srv

        self.observer, self.srv = observer, srv
        self.states = observer.listen(JointState, "/joint_states")
        words = ("-p", f"scene:={SCENE}", "-p", "duration:=0.0", "-p", "publish_rate:=100")
        self.process = nodes.start("simulator", "--ros-args", *words, env=env)

    def call(self, kind, **fields):
        name = "".join(f"_{c.lower()}" if c.isupper() else c for c in kind).removeprefix("_")
        return self.observer.call(getattr(self.srv, kind), f"{NODE}/{name}", **fields)

    def state(self):
        return self.call("GetSimulationState").state.state

    def to(self, state):
        from simulation_interfaces.msg import SimulationState

        wanted = SimulationState(state=state)
        return self.call("SetSimulationState", state=wanted).result.result


@pytest.fixture(scope="module")
def client(domain_of_module):
    with pytest.MonkeyPatch.context() as patch:
        folder = str(message_types.folder("simulation_interfaces"))
        patch.syspath_prepend(folder)
        env = {"PYTHONPATH": os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])}
        nodes, observer = Nodes(), Observer(domain_of_module)
        yield Client(nodes, observer, env)
        nodes.close()
        observer.close()


def test_features_states_and_scopes(client):
    features = client.call("GetSimulatorFeatures").features
    assert list(features.features) == list(FEATURES)
    client.observer.until(lambda: client.state() == PLAYING, "the run")
    assert client.call("StepSimulation", steps=1).result.result == FAILED
    assert client.to(PAUSED) == OK and client.state() == PAUSED
    assert client.call("ResetSimulation", scope=1).result.result == UNSUPPORTED
    assert client.state() == PAUSED
    assert client.call("ResetSimulation", scope=2).result.result == OK
    assert client.state() == STOPPED
    assert client.to(PLAYING) == OK and client.state() == PLAYING
    assert client.to(STOPPED) == OK and client.state() == STOPPED


def test_steps_by_count_and_by_the_action(client):
    from simulation_interfaces.action import SimulateSteps

    client.to(STOPPED)
    stamps = [client.observer.stamp(state) for state in client.states]
    before = len(set(stamps))

    def samples(count):
        return len({client.observer.stamp(s) for s in client.states}) >= before + count

    assert client.call("StepSimulation", steps=5).result.result == OK
    client.observer.until(partial(samples, 5), "five samples")
    action = ActionClient(client.observer.node, SimulateSteps, f"{NODE}/simulate_steps")
    client.observer.until(action.server_is_ready, "the action server")
    feedback = []

    def send(steps):
        feedback.clear()
        sent = action.send_goal_async(
            SimulateSteps.Goal(steps=steps), lambda message: feedback.append(message.feedback)
        )
        client.observer.until(sent.done, "the answer")
        return sent.result()

    def result(handle):
        done = handle.get_result_async()
        client.observer.until(done.done, "the result")
        return done.result().status, done.result().result.result

    # The long one first: feedback from before the server has found its reader is lost.
    handle = send(10**9)
    client.observer.until(lambda: len(feedback) > 3, "feedback")
    cancelled = handle.cancel_goal_async()
    client.observer.until(cancelled.done, "the answer")
    assert result(handle)[0] == GoalStatus.STATUS_CANCELED
    handle = send(7)
    # Before the result is asked for: after it rclpy's client hears no feedback.
    client.observer.until(lambda: len(feedback) >= 7, "feedback")
    status, reply = result(handle)
    assert (status, reply.result) == (GoalStatus.STATUS_SUCCEEDED, OK)
    counts = [(message.completed_steps, message.remaining_steps) for message in feedback]
    assert counts == [(k, 7 - k) for k in range(1, 8)]
    client.to(PLAYING)
    status, reply = result(send(3))
    assert (status, reply.result) == (GoalStatus.STATUS_ABORTED, FAILED)
    assert "running" in reply.error_message


def test_the_star_is_read_and_set_with_its_joints(client):
    from geometry_msgs.msg import Quaternion
    from simulation_interfaces.msg import EntityFilters, EntityState

    client.to(STOPPED)
    assert client.call("GetEntities").entities == ["star"]
    none = client.call("GetEntities", filters=EntityFilters(filter="^robot"))
    assert none.result.result == OK and not none.entities
    assert client.call("GetEntities", filters=EntityFilters(filter="(")).result.result == FAILED
    assert client.call("GetEntityState", entity="arm").result.result == NOT_FOUND

    scene = load_scene(SCENE)
    geometry = Geometry.of(scene)
    gamma = np.add(scene.initial.gamma, (0.03, -0.02, 0.01))
    rotation = kinematics.admissible(geometry, gamma).rotation
    x, y, z, w = quaternion_of(rotation).tolist()
    state = EntityState()
    state.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    turning = (0.1, -0.2, 0.3)
    state.twist.angular.x, state.twist.angular.y, state.twist.angular.z = turning
    given = {"entity": "star", "state": state}
    reply = client.call("SetEntityState", set_pose=True, set_twist=True, **given)
    assert reply.result.result == OK, reply.result.error_message
    client.observer.until(
        lambda: np.abs(np.subtract(client.states[-1].position[:3], gamma)).max() < 1e-9,
        "the state that was set",
    )
    # The rates of the carriages, r_k = r_k(gamma_k), close the loops: d/dt(r_k . R e_k) = 0.
    found = client.call("GetEntityState", entity="star").state
    assert found.header.frame_id == "base_link"
    read = found.pose.orientation
    assert np.abs(rotation_matrix((read.x, read.y, read.z, read.w)) - rotation).max() < 1e-9
    assert (found.twist.angular.x, found.twist.angular.y, found.twist.angular.z) == pytest.approx(
        turning, abs=1e-9
    )
    h = 1e-6
    after, before = (
        kinematics.inverse(geometry, _turned(sign * h, turning) @ rotation)[0] for sign in (1, -1)
    )
    rates = (after - before) / (2 * h)
    assert client.states[-1].velocity[:3] == pytest.approx(rates, abs=1e-7)
    listed = client.call("GetEntitiesStates")
    assert listed.entities == ["star"] and listed.states[0].pose == found.pose

    keep = client.call("SetEntityState", set_twist=True, entity="star", state=EntityState())
    assert keep.result.result == OK
    client.observer.until(lambda: not any(client.states[-1].velocity), "rest")
    for change, code in (
        ({"orientation": Quaternion(w=0.5)}, INVALID_POSE),
        ({"orientation": Quaternion(x=1.0, w=0.0)}, INVALID_POSE),
        ({"orientation": Quaternion(x=float("nan"))}, INVALID_POSE),
    ):
        bad = EntityState()
        for name, value in change.items():
            setattr(bad.pose, name, value)
        reply = client.call("SetEntityState", entity="star", state=bad, set_pose=True)
        assert reply.result.result == code and reply.result.error_message
    away = EntityState()
    away.pose.orientation, away.pose.position.z = state.pose.orientation, 0.1
    reply = client.call("SetEntityState", entity="star", state=away, set_pose=True)
    assert reply.result.result == INVALID_POSE and "position" in reply.result.error_message
    client.to(PLAYING)
    reply = client.call("SetEntityState", set_pose=True, **given)
    assert reply.result.result == FAILED and "running" in reply.result.error_message


def _turned(angle, axis):
    """Rotation by angle times axis, to second order."""
    x, y, z = np.multiply(angle, axis)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + across + 0.5 * across @ across


def test_spawning_is_refused_by_name_and_the_node_quits(client):
    reply = client.call("SpawnEntity", name="table")
    assert reply.result.result == UNSUPPORTED
    assert "table is not spawned" in reply.result.error_message
    assert client.to(QUITTING) == OK
    assert client.process.wait(20) == 0
    assert "Traceback" not in client.process.communicate()[1]
