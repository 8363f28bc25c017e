# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics controller: torques that follow a motion.

It answers every sample with such a torque. The motion is that of the scene, of
~/joint_trajectory, or of a goal of ~/follow_joint_trajectory, of which there is one at
a time.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import time
from array import array
from typing import Any

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
from sst_ros.nodes.process import AnsweringWorker, every
from sst_ros.report.results import render
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.torque_input import ACTUATED_JOINTS
from sst_ros.runtime.trajectory_following import Order, Stage, TrajectoryFollower
from sst_ros.runtime.trajectory_messages import ErrorCode, TrajectoryGoal
from sst_ros.scene import scene
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
_FEEDBACK_PERIOD_S = 0.05
_STREAM_LOG_PERIOD_S = 1.0  # trajectories of a stream are not logged more often
_SPINS_AT_END = 20
"""Spins to deliver the result of a goal that the end of the node aborts: 0.2 s."""
_SPIN_S = 0.01


class InverseDynamicsController(AnsweringWorker[ControllerNodeParameters]):
    """Worker of the process `inverse_dynamics`.

    It handles messages and time of a `TrajectoryFollower`.
    """

    def __init__(self) -> None:
        super().__init__("sst_inverse_dynamics", ControllerNodeParameters)
        parameters = self.parameters
        own = topics.CONTROLLER
        self.follower = TrajectoryFollower(scene.load(parameters.scene), parameters)
        names = ("reference", "tracking_error", "diagnostics")
        publishers = (own[name].publisher(self.node) for name in names)
        self._reference, self._error, self._diagnostics = publishers
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
        self._feedback: Any = None
        self._action_type: Any = None  # FollowJointTrajectory, where that is installed
        self.connect(own, joint_trajectory=self._replace)
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
        desired = command.desired
        for publisher, *numbers in (
            (self._reference, desired.gamma, desired.gamma_dot, command.feedforward),
            (self._error, command.error, command.error_rate, command.feedback),
        ):
            position, velocity, effort = (array("d", triple) for triple in numbers)
            message = JointState(position=position, velocity=velocity, effort=effort)
            message.header.stamp = state.header.stamp
            message.name = list(ACTUATED_JOINTS)
            publisher.publish(message)

    def _replace(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory of the topic, and no goal any more."""

        def settle(outcome: concurrent.futures.Future[None]) -> None:
            if self._is_accepted(outcome):
                self._interrupt("replaced by a trajectory of ~/joint_trajectory")

        if (order := self._take(trajectory)) is not None:
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
            self.heard_s = time.monotonic()

    def _is_accepted(self, outcome: concurrent.futures.Future[None]) -> bool:
        """Whether a trajectory is followed.

        Else count, log and publish the refusal, if any.
        """
        if outcome.cancelled():
            return False
        if (error := outcome.exception()) is not None:
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
        follower = self.follower
        stage = (
            "waiting for joint_states"
            if self._measured is None
            else follower.stage.value
        )
        counts = (
            follower.samples,
            follower.irregular,
            follower.limited,
            self.foreign_states,
        )
        refusals = self._refused, self._last_refusal
        row = (stage, self.parameters.mode, *counts, *follower.errors, *refusals)
        doubts = {
            "samples do not come at rate": follower.irregular,
            "torques are limited": follower.limited,
            "a trajectory was refused": self._refused,
        }
        statements = [stage, *(text for text, count in doubts.items() if count)]
        values = dict(zip(FOLLOWER_KEYS, row, strict=True))
        level = int(len(statements) > 1)
        message = topics.diagnostics(
            self.node, "control", level, "; ".join(statements), values
        )
        self._diagnostics.publish(message)

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
        self._feedback = state.header.stamp, goal.index(time), time, measured, command
        outcome = goal.outcome(time, command.error, command.error_rate)
        if outcome is None:
            return
        self._report_goal()
        self._end(*outcome)
        if outcome[0] is not ErrorCode.SUCCESSFUL:
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
        if (order := self._take(request.trajectory)) is None:
            return GoalResponse.REJECT
        checked: Future[None] = Future()
        order.outcome.add_done_callback(lambda _: checked.set_result(None))
        await checked
        if not self._is_accepted(order.outcome):
            return GoalResponse.REJECT
        self._interrupt("preempted by a new goal")
        self._goal = goal, order
        return GoalResponse.ACCEPT

    def _begin(self, handle: Any) -> None:
        self._active, self._feedback = topics.ActionGoal(handle), None
        if self._goal is not None and not self.follower.has(self._goal[1]):
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
        active, self._active = self._active, None
        assert active is not None
        self.node.get_logger().info(f"follow_joint_trajectory: {message}")
        result = self._action_type.Result(error_code=int(code), error_string=message)
        active.end(result, success=code is ErrorCode.SUCCESSFUL)

    def _report_goal(self) -> None:
        """Publish feedback of the last sample, once."""
        if not self._is_active() or self._feedback is None or self._active is None:
            return
        (stamp, index, time, measured, command), self._feedback = self._feedback, None
        desired = command.desired
        message = self._action_type.Feedback(joint_names=list(ACTUATED_JOINTS))
        message.header.stamp, message.index = stamp, index
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
    p, v = state.position, state.velocity
    return Measurement((p[i], p[j], p[k]), (v[i], v[j], v[k]))


def _print(tracking: TrackingMetrics | None) -> None:
    if tracking is not None:
        print(render("tracking.txt", found=tracking), flush=True)


def _point(
    time: float, angles: Vector3, rates: Vector3, torques: Vector3
) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint()
    point.positions, point.velocities = array("d", angles), array("d", rates)
    point.effort = array("d", torques)
    point.time_from_start = Duration(nanoseconds=round(time * NANOSECONDS)).to_msg()
    return point
