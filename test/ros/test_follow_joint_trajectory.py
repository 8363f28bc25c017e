# SPDX-License-Identifier: Apache-2.0
"""The action ~/follow_joint_trajectory with a real client, a real controller and simulator."""

import os
import signal

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState

from sst_ros.runtime.trajectory_goal import ErrorCode

from . import message_types
from .test_inverse_dynamics import AWAY, HOME, NAMES, controller_told, trajectory, written

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
NODE = "/sst_inverse_dynamics"
SUCCEEDED, CANCELED, ABORTED = (
    GoalStatus.STATUS_SUCCEEDED,
    GoalStatus.STATUS_CANCELED,
    GoalStatus.STATUS_ABORTED,
)


@pytest.fixture(scope="module")
def types():
    with pytest.MonkeyPatch.context() as patch:
        folder = str(message_types.folder("control_msgs"))
        patch.syspath_prepend(folder)
        yield {"PYTHONPATH": os.pathsep.join([folder, os.environ.get("PYTHONPATH", "")])}


class Client:
    """A client of the action, and the controller and the simulator that it moves."""

    def __init__(self, nodes, observer, folder, env):
        from control_msgs.action import FollowJointTrajectory
        from control_msgs.msg import JointTolerance
        from diagnostic_msgs.msg import DiagnosticArray

        self.kind, self.tolerance, self.observer = FollowJointTrajectory, JointTolerance, observer
        self.reference = observer.listen(JointState, f"{NODE}/reference")
        observer.listen(DiagnosticArray, "/diagnostics")
        path = written(folder, motion=None)
        self.simulator = nodes.run("simulator", scene=path, sync="lockstep")
        given = {"mode": "computed_torque", "stamped": "true", "motion": "topic", "scene": path}
        words = [f"-p{name}:={value}" for name, value in given.items()]
        words = [part for word in words for part in ("-p", word[2:])]
        self.controller = nodes.start("inverse_dynamics", "--ros-args", *words, env=env)
        self.client = ActionClient(
            observer.node, FollowJointTrajectory, f"{NODE}/follow_joint_trajectory"
        )
        observer.until(self.client.server_is_ready, "the action server")
        stage = "waiting for a trajectory"
        observer.until(lambda: stage in controller_told(observer, "stage"), "joint_states")
        self.feedback = []

    def send(self, *points, **given):
        message = trajectory(*points)
        goal = self.kind.Goal(trajectory=message, **given)
        self.feedback = []
        future = self.client.send_goal_async(
            goal, lambda message, into=self.feedback: into.append(message.feedback)
        )
        self.observer.until(future.done, "the answer to a goal")
        return future.result()

    def result(self, handle):
        future = handle.get_result_async()
        self.observer.until(future.done, "the result")
        return future.result().status, ErrorCode(future.result().result.error_code), future.result()

    def moving(self, count=3):
        self.observer.until(lambda: len(self.feedback) > count, "feedback")

    def rest(self):
        """Wait until the reference rests; return it."""
        seen = len(self.reference)
        self.observer.until(
            lambda: len(self.reference) > seen and not any(self.reference[-1].velocity), "rest"
        )
        return self.reference[-1].position

    def near(self, position, velocity=0.0, joint=NAMES[0]):
        return [self.tolerance(name=joint, position=position, velocity=velocity)]


@pytest.fixture(scope="module")
def client(types, tmp_path_factory, domain_of_module):
    from .conftest import Nodes, Observer

    nodes, observer = Nodes(), Observer(domain_of_module)
    yield Client(nodes, observer, tmp_path_factory.mktemp("goals"), types)
    nodes.close()
    observer.close()


def test_a_goal_is_followed_with_feedback_and_succeeds(client):
    handle = client.send((0.2, HOME), (0.6, AWAY))
    assert handle.accepted

    def times():
        found = [message.desired.time_from_start for message in client.feedback]
        return [time.sec + 1e-9 * time.nanosec for time in found]

    # rclpy takes one feedback at a time, and hears none of those left when the result comes.
    client.observer.until(lambda: max(times(), default=0.0) >= 0.6, "the last feedback")
    status, code, reply = client.result(handle)
    assert (status, code) == (SUCCEEDED, ErrorCode.SUCCESSFUL), reply
    assert len(client.feedback) > 3 and times() == sorted(times())
    for time, message in zip(times(), client.feedback, strict=True):
        assert message.joint_names == NAMES
        assert message.index == (0 if time < 0.2 else 1)
        off = np.subtract(message.desired.positions, message.actual.positions)
        assert np.array(message.error.positions) == pytest.approx(off, abs=1e-12)
        assert np.abs(off).max() < 1e-3 and message.header.stamp.sec > 0
    assert client.feedback[-1].actual.positions == pytest.approx(AWAY, abs=1e-3)


def test_what_cannot_be_followed_is_refused_with_a_reason(client):
    before = len(controller_told(client.observer, "last_refusal"))

    def reason():
        refusals = controller_told(client.observer, "last_refusal")[before:]
        return refusals[-1] if refusals else ""

    assert not client.send((1.0, np.add(HOME, (0.9, 0.0, 0.0)))).accepted
    client.observer.until(lambda: "gamma_1" in reason(), "the reason")
    assert not client.send((1.0, HOME), path_tolerance=client.near(0.1, joint="elbow")).accepted
    client.observer.until(lambda: "path_tolerance[0].name = 'elbow'" in reason(), "the reason")


def test_a_cancelled_goal_comes_to_rest_on_its_path(client):
    start = np.array(client.rest())
    far = np.where(np.abs(start - HOME).max() > 0.01, HOME, AWAY)
    handle = client.send((3.0, far))
    client.moving(8)
    reply = handle.cancel_goal_async()
    client.observer.until(reply.done, "the answer to the cancellation")
    assert len(reply.result().goals_canceling) == 1
    status, code, _ = client.result(handle)
    assert (status, code) == (CANCELED, ErrorCode.SUCCESSFUL)
    part = (np.array(client.rest()) - start) / np.where(far == start, np.inf, far - start)
    assert 0.0 < part[0] < 0.9 and part[1] == pytest.approx(part[0], abs=1e-9)


@pytest.mark.parametrize(
    ("given", "code", "reason"),
    [
        ({"path_tolerance": 1e-12}, ErrorCode.PATH_TOLERANCE_VIOLATED, "path tolerance 1e-12 rad"),
        ({"goal_tolerance": 1e-15}, ErrorCode.GOAL_TOLERANCE_VIOLATED, "goal tolerance 1e-15 rad"),
    ],
    ids=["path", "goal"],
)
def test_a_tolerance_aborts_a_goal(client, given, code, reason):
    start = np.array(client.rest())
    far = np.where(np.abs(start - HOME).max() > 0.01, HOME, AWAY)
    tolerances = {name: client.near(value) for name, value in given.items()}
    handle = client.send((0.3, tuple(far)), **tolerances)
    status, found, reply = client.result(handle)
    assert (status, found) == (ABORTED, code)
    assert reason in reply.result.error_string and "gamma_1" in reply.result.error_string
    assert not any(client.reference[-1].velocity) or client.rest()


def test_a_new_goal_and_a_trajectory_of_the_topic_preempt_a_goal(client):
    from trajectory_msgs.msg import JointTrajectory

    client.rest()
    first = client.send((3.0, AWAY))
    client.moving()
    second = client.send((3.0, HOME))
    status, code, reply = client.result(first)
    assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert reply.result.error_string == "preempted by a new goal"
    client.moving()
    topic = client.observer.publisher(JointTrajectory, f"{NODE}/joint_trajectory")
    ended = second.get_result_async()
    client.observer.publish_until(topic, trajectory((0.3, HOME)), ended.done, "the result")
    status, code, reply = client.result(second)
    assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert "~/joint_trajectory" in reply.result.error_string
    # The reference never jumped.
    gamma = np.array([message.position for message in client.reference])
    stamps = np.array([client.observer.stamp(message) for message in client.reference])
    slopes = np.diff(gamma, axis=0) / (np.diff(stamps) * 1e-9)[:, None]
    assert np.abs(slopes).max() < 3.0
    assert client.rest() == pytest.approx(HOME, abs=1e-12)


def test_the_end_of_the_controller_delivers_a_result(client):
    client.rest()
    handle = client.send((5.0, AWAY))
    client.moving()
    client.controller.send_signal(signal.SIGINT)
    status, code, reply = client.result(handle)
    assert (status, code) == (ABORTED, ErrorCode.INVALID_GOAL)
    assert reply.result.error_string == "the controller ends"
    assert client.controller.wait(20) == 0
    assert "Traceback" not in client.controller.communicate()[1]
