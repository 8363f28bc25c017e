# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics controller: torques that follow a motion.

It answers every sample with such a torque. The motion is that of the scene, of
~/joint_trajectory, or of a goal of ~/follow_joint_trajectory, of which there is one at
a time.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
from array import array
from typing import Any, NamedTuple

from rclpy.action.server import CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.control.controller import TrackingMetrics
from sst_ros.control.law import Command, Measurement
from sst_ros.errors import SstError
from sst_ros.nodes import topics
from sst_ros.nodes.answering import AnsweringWorker
from sst_ros.nodes.process import every
from sst_ros.report.results import render
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.trajectory_following import Order, Stage, TrajectoryFollower
from sst_ros.runtime.trajectory_messages import ErrorCode, TrajectoryGoal
from sst_ros.scene import scene
from sst_ros.scene.loads import ACTUATED_JOINTS
from sst_ros.state import NANOSECONDS, Vector3, nanoseconds

FOLLOWER_KEYS = {
    "stage": "stage of the motion",
    "mode": "control law",
    "samples": "samples answered",
    "samples_irregular": "samples that came at another period than that of rate",
    "samples_limited": "samples of the motion in which a torque was limited",
    "foreign_states": "messages on joint_states of other robots, which are ignored",
    "error_rms_rad": (
        "root of the mean square of the error of gamma_1..3 since the motion began"
    ),
    "error_max_rad": "largest error of gamma_1..3 since then",
    "trajectories_refused": "trajectories that were refused",
    "last_refusal": "reason of the last refusal",
}
"""Keys of the controller's /diagnostics, in order."""
_FEEDBACK_PERIOD_S = 0.05  # of a goal: more than an operator sees
_STREAM_LOG_PERIOD_S = 1.0  # trajectories of a stream are not logged more often
_SPINS_AT_END = 20
"""Spins to deliver the result of a goal that the end of the node aborts: 0.2 s."""
_SPIN_S = 0.01


class _Feedback(NamedTuple):
    """What is reported of a goal at a sample."""

    stamp: Any  # of the sample
    point_index: int  # of the point that is approached
    time: float  # of the trajectory [s]
    measured: Measurement
    command: Command


class InverseDynamicsController(AnsweringWorker[ControllerNodeParameters]):
    """Worker of the process `inverse_dynamics`.

    It handles messages and time of a `TrajectoryFollower`.
    """

    def __init__(self) -> None:
        own = topics.CONTROLLER
        super().__init__("sst_inverse_dynamics", ControllerNodeParameters, own)
        parameters = self.parameters
        self.follower = TrajectoryFollower(scene.load(parameters.scene), parameters)
        self._reference = own["reference"].publisher(self.node)
        self._error = own["tracking_error"].publisher(self.node)
        self._diagnostics = own["diagnostics"].publisher(self.node)
        self._measured: Measurement | None = None
        self._measured_ns = 0
        self._refused = 0
        self._last_refusal = ""
        self._has_heard = False
        self._active: topics.ActionGoal | None = None
        # the active one, or accepted last
        self._goal: tuple[TrajectoryGoal, Order] | None = None
        # Loads the template now: later that would delay the control.
        render("tracking.txt", found=TrackingMetrics())
        self._feedback: _Feedback | None = None
        self._action_type: Any = None  # FollowJointTrajectory, where that is installed
        self.connect(joint_trajectory=self._replace)
        every(self.node, 1.0, self._report)
        action = own["follow_joint_trajectory"]
        types = topics.optional_types(self.node, [action.type_name])
        if types is not None:
            self._action_type = types["FollowJointTrajectory"]
            topics.ActionGoal.serve(
                self.node,
                self._action_type,
                action.name,
                self._begin,
                goal_callback=self._check,
                cancel_callback=self._cancel,
                # samples come while a goal is checked
                callback_group=ReentrantCallbackGroup(),
            )
            every(self.node, _FEEDBACK_PERIOD_S, self._report_goal)

    def close(self) -> None:
        """Abort a goal, set zero torque, and print the tracking errors."""
        executor = self.node.executor
        if self._active is not None and executor is not None:
            reason = f": {self.failure}" if self.failure is not None else ""
            self._interrupt(f"the controller ends{reason}")
            for _ in range(_SPINS_AT_END):
                # of other callbacks: the node ends already
                with contextlib.suppress(SstError):
                    executor.spin_once(timeout_sec=_SPIN_S)
        super().close()
        self.follower.close()
        self._report()
        _print(self.follower.tracking())

    def change(self, changed: ControllerNodeParameters) -> None:
        """Apply gains from the next sample on: callbacks run one after the other."""
        self.follower.tune(changed)
        super().change(changed)

    def hear(self, phase: String) -> None:
        """End with the simulator; begin anew when it does.

        The first phase that is heard is no news: discovery may find this topic after
        joint_states, and the simulator's "waiting" then comes after the first samples
        of the run.
        """
        super().hear(phase)
        is_first = not self._has_heard
        self._has_heard = True
        if phase.data == "waiting" and self.begun and not is_first:
            self.node.get_logger().info("the simulator was reset: beginning anew")
            self._interrupt("the simulator was reset")
            _print(self.follower.tracking())
            self.follower.restart()
            self.begun = False

    def see(self, state: JointState) -> None:
        """Measure a state: trajectories begin at the last one."""
        self._measured = _measure(state)
        self._measured_ns = nanoseconds(state.header.stamp)

    def receive(self, state: JointState) -> None:
        """Answer a state where there is a motion."""
        super().receive(state)
        self.follower.proceed()

    def missing_subscribers(self) -> list[str]:
        """Return the topics that wait for subscribers.

        With wait_for_recorder its own topics are among them.
        """
        missing = super().missing_subscribers()
        if self.parameters.wait_for_recorder:
            recorded = (self._reference, self._error)
            missing += [
                publisher.topic_name
                for publisher in recorded
                if not publisher.get_subscription_count()
            ]
        return missing

    def preview(self) -> Vector3 | None:
        """Return the answer to the last state before the run [N m].

        Without a motion it is None.
        """
        command = self.follower.preview(self._measured) if self._measured else None
        return None if command is None else command.torque

    def answer(self, state: JointState, stamp_ns: int) -> None:
        """Answer a sample of the run."""
        if self._measured is None:
            return
        command = self.follower.answer(stamp_ns, self._measured)
        if command is None:
            return
        self.begun = True
        self.send(command.torque)
        self._publish(state, command)
        self._judge(state, self._measured, command)
        if self.follower.finished is not None:
            _print(self.follower.finished)
            self.follower.finished = None
        if self.follower.stage is Stage.ENDED:
            self.done.set()

    def _publish(self, state: JointState, command: Command) -> None:
        """Publish what is desired of a sample, and by how much it is missed."""
        desired = command.desired
        reference = _joint_state(desired.gamma, desired.gamma_dot, command.feedforward)
        error = _joint_state(command.error, command.error_rate, command.feedback)
        reference.header.stamp = state.header.stamp
        error.header.stamp = state.header.stamp
        self._reference.publish(reference)
        self._error.publish(error)

    def _replace(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory of the topic, and no goal any more."""

        def settle(outcome: concurrent.futures.Future[None]) -> None:
            if self._is_accepted(outcome):
                self._interrupt("replaced by a trajectory of ~/joint_trajectory")

        order = self._take(trajectory)
        if order is not None:
            order.outcome.add_done_callback(settle)

    def _take(self, trajectory: JointTrajectory) -> Order | None:
        """Have a trajectory checked and followed.

        None, with the reason logged, where it is bad.
        """
        try:
            return self.follower.take(trajectory, self._measured, self._measured_ns)
        except SstError as error:
            self._refuse(error)
            return None
        finally:
            # in lockstep no message was received meanwhile
            self.silent_looks = 0

    def _is_accepted(self, outcome: concurrent.futures.Future[None]) -> bool:
        """Whether a trajectory is followed.

        Else count, log and publish the refusal, if any.
        """
        if outcome.cancelled():
            return False
        error = outcome.exception()
        if error is not None:
            self._refuse(error)
            return False
        self.node.get_logger().info(
            "trajectory taken", throttle_duration_sec=_STREAM_LOG_PERIOD_S
        )
        return True

    def _refuse(self, error: BaseException) -> None:
        """Count, log and publish a refusal."""
        self._refused += 1
        self._last_refusal = str(error)
        self.node.get_logger().error(f"trajectory refused: {error}")
        self._report()

    def watch(self) -> None:
        """End after the run, when its last samples have been answered."""
        self.follower.proceed()
        super().watch()

    def _report(self) -> None:
        """Publish diagnostics: the keys are those of FOLLOWER_KEYS, in their order."""
        follower = self.follower
        stage = follower.stage.value
        if self._measured is None:
            stage = "waiting for joint_states"
        error_rms, error_max = follower.errors
        values = {
            "stage": stage,
            "mode": self.parameters.mode,
            "samples": follower.samples,
            "samples_irregular": follower.irregular,
            "samples_limited": follower.limited,
            "foreign_states": self.foreign_states,
            "error_rms_rad": error_rms,
            "error_max_rad": error_max,
            "trajectories_refused": self._refused,
            "last_refusal": self._last_refusal,
        }
        doubts: list[str] = []
        if follower.irregular:
            doubts.append("samples do not come at rate")
        if follower.limited:
            doubts.append("torques are limited")
        if self._refused:
            doubts.append("a trajectory was refused")
        text = "; ".join([stage, *doubts])
        level = 1 if doubts else 0
        self._diagnostics.publish(
            topics.diagnostics(self.node, "control", level, text, values)
        )

    def _judge(
        self, state: JointState, measured: Measurement, command: Command
    ) -> None:
        """Test the tolerances of the active goal at an answered sample of the run."""
        if self._goal is None or not self._is_active():
            return
        goal, order = self._goal
        if order is not self.follower.order:  # the motion before it is followed still
            return
        time = self.follower.time + order.passed
        point_index = goal.index(time)
        self._feedback = _Feedback(
            state.header.stamp, point_index, time, measured, command
        )
        outcome = goal.outcome(time, command.error, command.error_rate)
        if outcome is None:
            return
        self._report_goal()
        code, reason = outcome
        self._end(code, reason)
        if code is not ErrorCode.SUCCESSFUL:
            self.follower.stop()

    def _interrupt(self, reason: str) -> None:
        """Abort the active goal; what is followed now is not its concern any more."""
        if self._is_active():
            self._end(ErrorCode.INVALID_GOAL, reason)

    async def _check(self, request: Any) -> GoalResponse:
        try:
            goal = TrajectoryGoal(request, self.parameters)
        except SstError as error:
            self._refuse(error)
            return GoalResponse.REJECT
        order = self._take(request.trajectory)
        if order is None:
            return GoalResponse.REJECT
        checked: Future[None] = Future()
        order.outcome.add_done_callback(lambda _: checked.set_result(None))
        await checked
        if not self._is_accepted(order.outcome):
            return GoalResponse.REJECT
        self._interrupt("preempted by a new goal")
        self._goal = (goal, order)
        return GoalResponse.ACCEPT

    def _begin(self, handle: Any) -> None:
        """Follow an accepted goal, unless its trajectory has been replaced since."""
        self._active = topics.ActionGoal(handle)
        self._feedback = None
        if self._goal is None:
            return
        _, order = self._goal
        if not self.follower.has(order):
            self._interrupt("replaced by a newer trajectory")

    def _cancel(self, handle: Any) -> CancelResponse:
        """Stop; the goal ends after this call, when its handle is canceling."""
        if self._active is not None and self._active.handle == handle:
            self.follower.stop()
        return CancelResponse.ACCEPT

    def _is_active(self) -> bool:
        """Whether there is a goal; one that was canceled ends."""
        if self._active is not None and self._active.handle.is_cancel_requested:
            self._end(ErrorCode.SUCCESSFUL, "canceled")
        return self._active is not None

    def _end(self, code: ErrorCode, message: str) -> None:
        active = self._active
        self._active = None
        assert active is not None
        self.node.get_logger().info(f"follow_joint_trajectory: {message}")
        result = self._action_type.Result(error_code=int(code), error_string=message)
        active.end(result, success=code is ErrorCode.SUCCESSFUL)

    def _report_goal(self) -> None:
        """Publish feedback of the last sample, once."""
        if not self._is_active() or self._feedback is None or self._active is None:
            return
        stamp, index, time, measured, command = self._feedback
        self._feedback = None
        desired = command.desired
        message = self._action_type.Feedback(joint_names=list(ACTUATED_JOINTS))
        message.header.stamp = stamp
        message.index = index
        message.desired = _point(
            time, desired.gamma, desired.gamma_dot, command.feedforward
        )
        message.desired.accelerations = array("d", desired.gamma_ddot)
        message.actual = _point(
            time, measured.gamma, measured.gamma_dot, command.torque
        )
        message.error = _point(
            time, command.error, command.error_rate, command.feedback
        )
        self._active.handle.publish_feedback(message)


def _measure(state: JointState) -> Measurement:
    """Read the actuators, which may come in any order, among others."""
    names = list(state.name)
    if not len(names) == len(state.position) == len(state.velocity):
        raise SstError("joint_states must have a position and a velocity for each name")
    i, j, k = map(names.index, ACTUATED_JOINTS)
    angles = state.position
    rates = state.velocity
    return Measurement(
        (angles[i], angles[j], angles[k]), (rates[i], rates[j], rates[k])
    )


def _joint_state(angles: Vector3, rates: Vector3, torques: Vector3) -> JointState:
    """Make a message of numbers of the actuators [rad], [rad/s], [N m]."""
    return JointState(
        name=list(ACTUATED_JOINTS),
        position=array("d", angles),
        velocity=array("d", rates),
        effort=array("d", torques),
    )


def _print(tracking: TrackingMetrics | None) -> None:
    if tracking is not None:
        print(render("tracking.txt", found=tracking), flush=True)


def _point(
    time: float, angles: Vector3, rates: Vector3, torques: Vector3
) -> JointTrajectoryPoint:
    """Make a point of a trajectory at a time [s] of numbers of the actuators."""
    point = JointTrajectoryPoint()
    point.positions = array("d", angles)
    point.velocities = array("d", rates)
    point.effort = array("d", torques)
    point.time_from_start = Duration(nanoseconds=round(time * NANOSECONDS)).to_msg()
    return point
