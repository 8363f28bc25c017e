# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics controller: answers every sample with the torque that follows a motion."""

from __future__ import annotations

import threading
from array import array

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from sst_ros.control.controller import Command, Measurement
from sst_ros.control.tracking import table
from sst_ros.errors import SstError
from sst_ros.mechanism.generic_math import ZERO, axpy
from sst_ros.nodes import parameters, topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.follow_joint_trajectory import FollowJointTrajectoryServer
from sst_ros.nodes.messages import diagnostics
from sst_ros.nodes.torque_commands import TorqueCommands
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.runtime.trajectory_following import Stage, TrajectoryFollower
from sst_ros.scene import scene

KEYS = {
    "stage": "stage of the motion",
    "mode": "control law",
    "samples": "samples answered",
    "samples_irregular": "samples that came at another period than that of rate",
    "samples_limited": "samples of the motion in which a torque was limited",
    "error_rms_rad": "root of the mean square of the error of gamma_1..3 since the motion began",
    "error_max_rad": "largest error of gamma_1..3 since then",
    "trajectories_refused": "trajectories that were refused",
    "last_refusal": "reason of the last refusal",
}
"""Keys of the controller's /diagnostics, in order."""


class InverseDynamicsController:
    """Worker of the process `inverse_dynamics`: messages and time of a `TrajectoryFollower`."""

    def __init__(self) -> None:
        self.node = Node("sst_inverse_dynamics")
        self.done = threading.Event()
        given = self._parameters = parameters.declare(self.node, ControllerNodeParameters)
        self._follower = TrajectoryFollower(scene.load(given.scene), given)
        self._commands = TorqueCommands(self.node, given)
        self._reference = topics.REFERENCE.publisher(self.node)
        self._error = topics.TRACKING_ERROR.publisher(self.node)
        self._diagnostics = topics.DIAGNOSTICS.publisher(self.node)
        self._seen: Measurement | None = None
        self._places: tuple[list[str], list[int]] = ([], [])
        self._began = self._finished = False
        topics.CONTROLLER_PHASE.subscription(self.node, self._hear, simulator=given.simulator)
        topics.CONTROLLED.subscription(self.node, self._answer)
        topics.JOINT_TRAJECTORY.subscription(self.node, self._replace)
        self._goals = FollowJointTrajectoryServer(
            self.node, self._follower, given, self._take, self._refuse
        )
        self.node.create_timer(0.5, self._watch, clock=STEADY)
        self.node.create_timer(1.0, self._report, clock=STEADY)

    def close(self) -> None:
        """Leave the actuators without torque, and print the tracking errors."""
        self._goals.close()
        if self._began and not self.done.is_set():
            self._commands.send(ZERO)
        self._report()
        self._print()

    def _hear(self, phase: String) -> None:
        """End with the simulator; begin anew when it does."""
        if phase.data.startswith("fault") and self._began:
            raise SstError(f"the simulator stopped: {phase.data}")
        if phase.data == "finished" and self._began:
            self._finished = True
        if phase.data == "waiting" and self._began:
            self.node.get_logger().info("the simulator was reset: beginning anew")
            self._goals.interrupt("the simulator was reset")
            self._print()
            self._follower.restart()
            self._began = False

    def _answer(self, state: JointState) -> None:
        """Answer a state: of the run, or shown before it."""
        self._commands.received()
        self._seen = self._measured(state)
        if not self._has_subscribers():
            return
        stamp_ns = self._commands.answering(state)
        if stamp_ns == 0:
            command = None if self._began else self._follower.preview(self._seen)
            if command is not None:
                self._commands.send(command.torque)
            return
        command = self._follower.answer(stamp_ns, self._seen)
        if command is None:
            return
        self._began = True
        self._commands.send(command.torque)
        self._publish(state, self._seen, command)
        self._goals.sample(state, self._seen, command)
        if self._follower.stage is Stage.ENDED:
            self.done.set()

    def _has_subscribers(self) -> bool:
        """Whether the subscribers are there that the parameters ask for."""
        if self._began or not self._commands.subscribed():
            return self._began
        recorded = (self._reference, self._error) if self._parameters.wait_for_recorder else ()
        return all(publisher.get_subscription_count() for publisher in recorded)

    def _measured(self, state: JointState) -> Measurement:
        """Read the actuators, which may come in any order, among others.

        Raises:
            SstError: one is missing; nothing can be controlled by such messages.

        """
        names = list(state.name)
        if names != self._places[0]:
            absent = [name for name in ACTUATORS if name not in names]
            if absent:
                raise SstError(f"joint_states has no {', '.join(absent)}: its names are {names}")
            self._places = (names, [names.index(name) for name in ACTUATORS])
        if not len(names) == len(state.position) == len(state.velocity):
            raise SstError("joint_states must have a position and a velocity for each name")
        i, j, k = self._places[1]
        p, v = state.position, state.velocity
        return Measurement((p[i], p[j], p[k]), (v[i], v[j], v[k]))

    def _publish(self, state: JointState, seen: Measurement, command: Command) -> None:
        """Publish reference and tracking error under the stamp of the sample."""
        at = command.desired
        off = axpy(1.0, at.gamma, -1.0, seen.gamma), axpy(1.0, at.gamma_dot, -1.0, seen.gamma_dot)
        for publisher, (position, velocity), effort in (
            (self._reference, (at.gamma, at.gamma_dot), command.feedforward),
            (self._error, off, command.feedback),
        ):
            message = JointState(name=list(ACTUATORS))
            message.header.stamp = state.header.stamp
            message.position, message.velocity = array("d", position), array("d", velocity)
            message.effort = array("d", effort)
            publisher.publish(message)

    def _replace(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory of the topic, and no goal any more."""
        if self._take(trajectory):
            self._goals.interrupt("replaced by a trajectory of ~/joint_trajectory")

    def _take(self, trajectory: JointTrajectory) -> bool:
        """Follow a trajectory, or log why not; return whether it is followed."""
        try:
            tracking = self._follower.tracking()
            self._follower.take(trajectory, self._seen)
        except SstError as error:
            self._refuse(error)
            return False
        finally:
            self._commands.received()  # no message could be received during the check
        if tracking is not None:
            print(table(tracking), flush=True)
        self.node.get_logger().info(f"trajectory of {len(trajectory.points)} points taken")
        return True

    def _refuse(self, error: SstError) -> None:
        """Count, log and publish a refusal."""
        self._follower.refuse(error)
        self.node.get_logger().error(f"trajectory refused: {error}")
        self._report()

    def _watch(self) -> None:
        if self._finished:
            self.done.set()
        else:
            self._commands.watch()

    def _report(self) -> None:
        """Publish the diagnostics."""
        follower = self._follower
        rms, largest = follower.errors
        stage = "waiting for joint_states" if self._seen is None else follower.stage.value
        values: dict[str, object] = {
            "stage": stage,
            "mode": self._parameters.mode,
            "samples": follower.samples,
            "samples_irregular": follower.irregular,
            "samples_limited": follower.limited,
            "error_rms_rad": rms,
            "error_max_rad": largest,
            "trajectories_refused": follower.refused,
            "last_refusal": follower.last_refusal,
        }
        doubts = [
            words
            for count, words in (
                (follower.irregular, "samples do not come at rate"),
                (follower.limited, "torques are limited"),
                (follower.refused, "a trajectory was refused"),
            )
            if count
        ]
        level = DiagnosticStatus.WARN if doubts else DiagnosticStatus.OK
        name = f"{self.node.get_fully_qualified_name()}: control"
        stamp_ns = self.node.get_clock().now().nanoseconds
        text = "; ".join([stage, *doubts])
        self._diagnostics.publish(diagnostics(name, stamp_ns, level, text, values))

    def _print(self) -> None:
        """Print the tracking errors of the last motion."""
        if (tracking := self._follower.tracking()) is not None:
            print(table(tracking), flush=True)
