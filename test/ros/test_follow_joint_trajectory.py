# SPDX-License-Identifier: Apache-2.0
"""The action ~/follow_joint_trajectory with a real client, a real controller and
simulator.
"""

import signal
from contextlib import closing

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from programs import own_domain
from rclpy.action import ActionClient
from ros.conftest import NAMES, Nodes, Observer, foreign_types
from ros.test_inverse_dynamics import AWAY, HOME, trajectory, written
from sensor_msgs.msg import JointState
from slow_cases import slow_after
from trajectory_msgs.msg import JointTrajectory

from sst_ros.runtime.trajectory_messages import ErrorCode
from sst_ros.state import nanoseconds

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
NODE = "/sst_inverse_dynamics"
SUCCEEDED = GoalStatus.STATUS_SUCCEEDED, ErrorCode.SUCCESSFUL
CANCELED = GoalStatus.STATUS_CANCELED, ErrorCode.SUCCESSFUL
PREEMPTED = GoalStatus.STATUS_ABORTED, ErrorCode.INVALID_GOAL


@pytest.fixture(scope="module")
def types():
    yield from foreign_types("control_msgs")


class Client:
    """A client of the action, and the controller and the simulator that it moves."""

    def __init__(self, nodes, observer, folder, env, sync):
        from control_msgs.action import FollowJointTrajectory
        from control_msgs.msg import JointTolerance

        self.kind, self.tolerance = FollowJointTrajectory, JointTolerance
        self.observer, self.nodes = observer, nodes
        self.reference = observer.listen(JointState, f"{NODE}/reference")
        path = written(folder, motion=None)
        given = {"mode": "computed_torque", "motion": "topic", "scene": path}
        given["stamped"] = sync == "lockstep"
        given["allow_partial_joints_goal"] = True
        self.largest_error = 1e-3  # of gamma, between a goal's begin and end [rad]
        if sync == "lockstep":
            run = {"lockstep_timeout": 0.0}  # a busy machine checks a goal for long
        else:
            # A busy machine lets the controller wait for seconds, in which a torque is
            # held. Slowly, and with little feedback, the loop is stable nonetheless.
            # How far it falls behind depends on the machine alone and is not bounded.
            run = {"real_time_factor": 0.05}
            given["bandwidth"] = 10.0
            self.largest_error = np.inf
        nodes.run("simulator", scene=path, sync=sync, wait_for_command=True, **run)
        self.controller = nodes.start("inverse_dynamics", env=env, **given)
        self.client = ActionClient(
            observer.node, FollowJointTrajectory, f"{NODE}/follow_joint_trajectory"
        )
        observer.until(self.client.server_is_ready, "the action server")
        observer.told("stage", "waiting for a trajectory")
        self.feedback = []

    def send(self, *points, names=NAMES, **given):
        goal = self.kind.Goal(trajectory=trajectory(*points, names=names), **given)
        self.feedback = []
        future = self.client.send_goal_async(
            goal, lambda message, into=self.feedback: into.append(message.feedback)
        )
        return self.observer.result(future, "the answer to a goal")

    def result(self, handle):
        """Status and code, and the words of the result."""
        return self.read(handle.get_result_async())

    def read(self, requested):
        """The same of a result that has been requested."""
        reply = self.observer.result(requested, "the result")
        return (
            reply.status,
            ErrorCode(reply.result.error_code),
        ), reply.result.error_string

    def times(self):
        """Times of the feedback on its trajectory [s]."""
        return [
            1e-9 * nanoseconds(message.desired.time_from_start)
            for message in self.feedback
        ]

    def reached(self, time):
        """Wait for the feedback of a time on the trajectory [s].

        To be called before the result: rclpy takes one feedback at a time, and hears
        none of those left when the result comes.
        """
        self.observer.until(
            lambda: max(self.times(), default=0.0) >= time, "the last feedback"
        )

    def moving(self, count=3):
        self.observer.until(lambda: len(self.feedback) > count, "feedback")

    def rest(self):
        """Wait until the reference rests; return it.

        Before the first goal there is none: a test that runs alone sends one.
        """
        if not self.reference:
            assert self.result(self.send((0.2, HOME)))[0] == SUCCEEDED
        seen = len(self.reference)
        self.observer.until(
            lambda: len(self.reference) > seen and not any(self.reference[-1].velocity),
            "rest",
        )
        return np.array(self.reference[-1].position)

    def far_from(self, start):
        """HOME or AWAY, whichever is not there."""
        return np.where(np.abs(start - HOME).max() > 0.01, HOME, AWAY)

    def arrives(self, gamma):
        """Wait until the manipulator is at these angles."""

        def off():
            return np.abs(np.subtract(states[-1].position[:3], gamma)).max()

        states = self.observer.states
        self.observer.until(lambda: states and off() < 1e-3, "the end of the goal")

    def near(self, position, joint=NAMES[0]):
        return [self.tolerance(name=joint, position=position)]


@pytest.fixture(
    scope="module", params=slow_after(1, ["lockstep", "free"], mark=pytest.mark.breadth)
)
def client(types, tmp_path_factory, request):
    """Clients of two runs, each in a domain of its own."""
    with (
        own_domain() as domain,
        closing(Nodes()) as nodes,
        closing(Observer(domain)) as observer,
    ):
        yield Client(
            nodes, observer, tmp_path_factory.mktemp("goals"), types, request.param
        )


def test_a_goal_is_followed_with_feedback_and_succeeds(client):
    handle = client.send((0.2, HOME), (0.6, AWAY))
    assert handle.accepted
    client.reached(0.6)
    ending, said = client.result(handle)
    assert ending == SUCCEEDED, said
    times = client.times()
    assert len(times) > 3 and times == sorted(times)
    for time, message in zip(times, client.feedback, strict=True):
        assert message.joint_names == NAMES
        assert message.index == (0 if time < 0.2 else 1)
        off = np.subtract(message.desired.positions, message.actual.positions)
        assert np.array(message.error.positions) == pytest.approx(off, abs=1e-12)
        assert np.abs(off).max() < client.largest_error
        assert message.header.stamp.sec > 0
    client.arrives(AWAY)


def test_a_goal_of_some_joints_leaves_the_others(client):
    start = client.rest()
    far = client.far_from(start)
    handle = client.send((0.4, far[1:2]), names=NAMES[1:2])
    assert handle.accepted
    client.reached(0.4)
    ending, said = client.result(handle)
    assert ending == SUCCEEDED, said
    expected = [start[0], far[1], start[2]]
    assert client.rest() == pytest.approx(expected, abs=1e-12)
    assert client.feedback[-1].joint_names == NAMES
    client.arrives(expected)
    back = client.send((0.4, start))
    assert client.result(back)[0] == SUCCEEDED


def test_what_cannot_be_followed_is_refused_with_a_reason(client):
    assert not client.send((1.0, np.add(HOME, (0.9, 0.0, 0.0)))).accepted
    client.observer.told("last_refusal", lambda reason: "gamma_1" in reason)
    assert not client.send(
        (1.0, HOME), path_tolerance=client.near(0.1, joint="elbow")
    ).accepted
    elbow = "path_tolerance[0].name = 'elbow'"
    client.observer.told("last_refusal", lambda reason: elbow in reason)


def test_a_cancelled_goal_comes_to_rest_on_its_path(client):
    start = client.rest()
    far = client.far_from(start)
    handle = client.send((20.0, far))
    client.moving(8)
    reply = client.observer.result(
        handle.cancel_goal_async(), "the answer to the cancellation"
    )
    assert len(reply.goals_canceling) == 1
    assert client.result(handle)[0] == CANCELED
    part = (client.rest() - start) / np.where(far == start, np.inf, far - start)
    assert 0.0 < part[0] < 0.9 and part[1] == pytest.approx(part[0], abs=1e-9)


@pytest.mark.parametrize(
    ("given", "code", "reason"),
    [
        (
            {"path_tolerance": 1e-12},
            ErrorCode.PATH_TOLERANCE_VIOLATED,
            "path tolerance 1e-12 rad",
        ),
        (
            {"goal_tolerance": 1e-15},
            ErrorCode.GOAL_TOLERANCE_VIOLATED,
            "goal tolerance 1e-15 rad",
        ),
    ],
    ids=["path", "goal"],
)
def test_a_tolerance_aborts_a_goal(client, given, code, reason):
    far = client.far_from(client.rest())
    tolerances = {name: client.near(value) for name, value in given.items()}
    ending, said = client.result(client.send((0.3, tuple(far)), **tolerances))
    assert ending == (GoalStatus.STATUS_ABORTED, code)
    assert reason in said and "gamma_1" in said
    client.rest()


def test_a_new_goal_and_a_trajectory_of_the_topic_preempt_a_goal(client):
    client.rest()
    first = client.send((20.0, AWAY))
    client.moving()
    second = client.send((20.0, HOME))
    assert client.result(first) == (PREEMPTED, "preempted by a new goal")
    client.moving()
    topic = client.observer.publisher(JointTrajectory, f"{NODE}/joint_trajectory")
    ended = second.get_result_async()
    client.observer.publish_until(
        topic, trajectory((0.3, HOME)), ended.done, "the result"
    )
    ending, said = client.result(second)
    assert ending == PREEMPTED and "~/joint_trajectory" in said
    # The reference never jumped.
    gamma = np.array([message.position for message in client.reference])
    stamps = np.array([client.observer.stamp(message) for message in client.reference])
    slopes = np.diff(gamma, axis=0) / (np.diff(stamps) * 1e-9)[:, None]
    assert np.abs(slopes).max() < 3.0
    assert client.rest() == pytest.approx(HOME, abs=1e-12)


def test_the_end_of_the_controller_delivers_a_result(client):
    client.rest()
    # Requested before the end, for the controller delivers it within 0.2 s.
    requested = client.send((20.0, AWAY)).get_result_async()
    client.moving()
    client.controller.send_signal(signal.SIGINT)
    assert client.read(requested) == (PREEMPTED, "the controller ends")
    assert client.nodes.ended(client.controller)[0] == 0
