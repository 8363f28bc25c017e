# SPDX-License-Identifier: Apache-2.0
"""The action ~/follow_joint_trajectory, where control_msgs is installed.

As joint_trajectory_controller of ros2_controllers does it: one goal at a time, which a new one
preempts; a goal that is cancelled or aborted comes to rest and holds.
"""

from __future__ import annotations

import contextlib
from array import array
from collections.abc import Callable
from typing import Any

from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.control.controller import Command, Measurement
from sst_ros.errors import SstError
from sst_ros.mechanism.generic_math import axpy
from sst_ros.nodes import topics
from sst_ros.nodes.action_goal import ActionGoal
from sst_ros.nodes.clocks import STEADY
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.runtime.trajectory_following import TrajectoryFollower
from sst_ros.runtime.trajectory_goal import ErrorCode, TrajectoryGoal
from sst_ros.simulation.simulation import NANOSECONDS
from sst_ros.state import Vector3

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:  # not part of every installation, nor of the wheels
    FollowJointTrajectory = None

_FEEDBACK_PERIOD_S = 0.05
_SPINS_AT_END = 20
_SPIN_S = 0.01
"""Least time to deliver the result of a goal that the end of the node aborts: 0.2 s."""


class _ActiveGoal(ActionGoal):
    def __init__(self, handle: Any, goal: TrajectoryGoal) -> None:
        super().__init__(handle)
        self.goal = goal
        self.feedback: Any = None


class FollowJointTrajectoryServer:
    """Serves the action: goals for a `TrajectoryFollower`, one at a time.

    Args:
        node: the node.
        follower: follows the trajectories.
        settings: default tolerances.
        take: checks and takes a trajectory; returns whether it is followed.
        refuse: logs why a goal is refused.

    """

    def __init__(
        self,
        node: Node,
        follower: TrajectoryFollower,
        settings: ControllerNodeParameters,
        take: Callable[[JointTrajectory], bool],
        refuse: Callable[[SstError], None],
    ) -> None:
        self._node, self._follower, self._settings = node, follower, settings
        self._take, self._refuse = take, refuse
        self._active: _ActiveGoal | None = None
        self._accepted: TrajectoryGoal | None = None
        if FollowJointTrajectory is None:
            return
        self._server: Any = ActionServer(
            node,
            FollowJointTrajectory,
            topics.FOLLOW_JOINT_TRAJECTORY.name,
            lambda _: FollowJointTrajectory.Result(),
            goal_callback=self._check,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
        )
        node.create_timer(_FEEDBACK_PERIOD_S, self._report, clock=STEADY)

    def sample(self, state: JointState, measured: Measurement, command: Command) -> None:
        """Test the tolerances of the active goal at a sample of the run that was answered."""
        active = self._active
        if active is None or self._canceled(active):
            return
        time = self._follower.time
        active.feedback = state.header.stamp, time, measured, command
        outcome = active.goal.outcome(time, command.desired, measured)
        if outcome is None:
            return
        self._report()
        self._end(outcome.code, outcome.message)
        if outcome.code is not ErrorCode.SUCCESSFUL:
            self._follower.stop()

    def interrupt(self, reason: str) -> None:
        """Abort the active goal; what is followed now is not its concern any more."""
        if self._active is not None and not self._canceled(self._active):
            self._end(ErrorCode.INVALID_GOAL, reason)

    def close(self) -> None:
        """Abort the active goal and deliver its result."""
        executor = self._node.executor
        if self._active is None or executor is None:
            return
        self.interrupt("the controller ends")
        for _ in range(_SPINS_AT_END):
            with contextlib.suppress(SstError):  # of other callbacks: the node ends already
                executor.spin_once(timeout_sec=_SPIN_S)

    def _check(self, goal: Any) -> GoalResponse:
        try:
            self._accepted = TrajectoryGoal(goal, self._settings)
        except SstError as error:
            self._refuse(error)
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT if self._take(goal.trajectory) else GoalResponse.REJECT

    def _begin(self, handle: Any) -> None:
        self.interrupt("preempted by a new goal")
        assert self._accepted is not None
        self._active = _ActiveGoal(handle, self._accepted)

    def _cancel(self, handle: Any) -> CancelResponse:
        """Stop; the goal ends after this call, when its handle has changed to canceling."""
        if self._active is not None and self._active.handle == handle:
            self._follower.stop()
        return CancelResponse.ACCEPT

    def _canceled(self, active: _ActiveGoal) -> bool:
        if active.handle.is_cancel_requested:
            self._end(ErrorCode.SUCCESSFUL, "canceled")
        return self._active is None

    def _end(self, code: ErrorCode, message: str) -> None:
        active, self._active = self._active, None
        assert active is not None
        self._node.get_logger().info(f"follow_joint_trajectory: {message}")
        result = FollowJointTrajectory.Result(error_code=int(code), error_string=message)
        active.end(result, success=code is ErrorCode.SUCCESSFUL)

    def _report(self) -> None:
        """Publish feedback of the last sample, once."""
        active = self._active
        if active is None or self._canceled(active) or active.feedback is None:
            return
        (stamp, time, measured, command), active.feedback = active.feedback, None
        desired, total = command.desired, command.torque
        message = FollowJointTrajectory.Feedback(joint_names=list(ACTUATORS))
        message.header.stamp, message.index = stamp, active.goal.index(time)
        off = axpy(1.0, desired.gamma, -1.0, measured.gamma)
        rates = axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot)
        message.desired = _point(time, desired.gamma, desired.gamma_dot, command.feedforward)
        message.desired.accelerations = array("d", desired.gamma_ddot)
        message.actual = _point(time, measured.gamma, measured.gamma_dot, total)
        message.error = _point(time, off, rates, command.feedback)
        active.handle.publish_feedback(message)


def _point(time: float, angles: Vector3, rates: Vector3, torques: Vector3) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint()
    point.positions, point.velocities = array("d", angles), array("d", rates)
    point.effort = array("d", torques)
    nanoseconds = round(time * NANOSECONDS)
    point.time_from_start.sec, point.time_from_start.nanosec = divmod(nanoseconds, NANOSECONDS)
    return point
