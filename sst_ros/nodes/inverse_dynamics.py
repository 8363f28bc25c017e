# SPDX-License-Identifier: Apache-2.0
"""The companion: answers every joint state with the torque that follows a desired motion."""

from __future__ import annotations

import sys
import threading
from array import array

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from sst_ros import scene
from sst_ros.control.controller import Command, Measurement
from sst_ros.control.tracking import table
from sst_ros.errors import SstError
from sst_ros.mechanism.vec3 import ZERO, axpy
from sst_ros.nodes import middleware, parameters, process, topics
from sst_ros.nodes.clocks import STEADY
from sst_ros.nodes.messages import diagnostics
from sst_ros.nodes.torque_commands import TorqueCommands
from sst_ros.runtime.controller_node_settings import CompanionParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.runtime.trajectory_following import Pursuit, Stage

KEYS = {
    "stage": "what it does",
    "mode": "the controller",
    "samples": "samples answered",
    "samples_irregular": "samples that came at another time than rate says",
    "samples_limited": "samples of the motion in which a torque was limited",
    "error_rms_rad": "root of the mean square of the error of gamma_1..3 since the motion began",
    "error_max_rad": "largest error of gamma_1..3 since then",
    "trajectories_refused": "trajectories that were not taken",
    "last_refusal": "why the last one was not",
}
"""Keys of the companion's /diagnostics, in order."""


class InverseDynamics:
    """Worker of the process `inverse_dynamics`: messages and time; `Pursuit` does the work."""

    def __init__(self) -> None:
        self.node = Node("sst_inverse_dynamics")
        self.done = threading.Event()
        given = self._parameters = parameters.declare(self.node, CompanionParameters)
        self._pursuit = Pursuit(scene.load(given.scene), given)
        self._commands = TorqueCommands(self.node, given)
        self._reference = topics.REFERENCE.publisher(self.node)
        self._error = topics.TRACKING_ERROR.publisher(self.node)
        self._diagnostics = topics.DIAGNOSTICS.publisher(self.node)
        self._seen: Measurement | None = None
        self._places: tuple[list[str], list[int]] = ([], [])
        self._began = self._finished = False
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, f"{given.simulator}/phase", self._hear, latched)
        self.node.create_subscription(JointState, "joint_states", self._answer, 1)
        taken = topics.JOINT_TRAJECTORY
        self.node.create_subscription(taken.kind, taken.name, self._take, taken.depth)
        self.node.create_timer(0.5, self._watch, clock=STEADY)
        self.node.create_timer(1.0, self._report, clock=STEADY)

    def close(self) -> None:
        """Leave the actuators without torque, and tell how well the motion was followed."""
        if self._began and not self.done.is_set():
            self._commands.send(ZERO)
        self._report()
        self._tell()
        told = (self._commands.publisher, self._reference, self._error, self._diagnostics)
        middleware.finish(told)

    def _hear(self, phase: String) -> None:
        """End with the simulator; begin anew when it does."""
        if phase.data.startswith("fault") and self._began:
            raise SstError(f"the simulator stopped: {phase.data}")
        if phase.data == "finished" and self._began:
            self._finished = True
        if phase.data == "waiting" and self._began:
            self.node.get_logger().info("the simulator was reset: beginning anew")
            self._tell()
            self._pursuit.anew()
            self._began = False

    def _answer(self, state: JointState) -> None:
        """Answer a sample; stamp zero means that it is of no run."""
        self._commands.heard()
        self._seen = self._measured(state)
        if not self._is_read():
            return
        stamp_ns = self._commands.answering(state)
        if stamp_ns == 0:
            command = None if self._began else self._pursuit.preview(self._seen)
            if command is not None:
                self._commands.send(command.torque)
            return
        command = self._pursuit.answer(stamp_ns, self._seen)
        if command is None:
            return
        self._began = True
        self._commands.send(command.torque)
        self._publish(state, self._seen, command)
        if self._pursuit.stage is Stage.ENDED:
            self.done.set()

    def _is_read(self) -> bool:
        """Tell whether those are there whom the parameters say to wait for."""
        if self._began or not self._commands.are_read():
            return self._began
        told = (self._reference, self._error) if self._parameters.wait_for_recorder else ()
        return all(publisher.get_subscription_count() for publisher in told)

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
        """Tell what was wanted and what was missing, under the stamp of the sample."""
        at = command.desired
        off = axpy(1.0, at.gamma, -1.0, seen.gamma), axpy(1.0, at.gamma_dot, -1.0, seen.gamma_dot)
        for publisher, (position, velocity), effort in (
            (self._reference, (at.gamma, at.gamma_dot), command.feedforward),
            (self._error, off, command.feedback),
        ):
            message = JointState(name=ACTUATORS)
            message.header.stamp = state.header.stamp
            message.position, message.velocity = array("d", position), array("d", velocity)
            message.effort = array("d", effort)
            publisher.publish(message)

    def _take(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory, or say why not."""
        log = self.node.get_logger()
        try:
            judged = self._pursuit.judged()
            self._pursuit.take(trajectory, self._seen)
        except SstError as error:
            log.error(f"trajectory refused: {error}")
            self._report()
            return
        finally:
            self._commands.heard()  # nothing could be heard during the check
        if judged is not None:
            print(table(judged), flush=True)
        log.info(f"trajectory of {len(trajectory.points)} points taken")

    def _watch(self) -> None:
        if self._finished:
            self.done.set()
        else:
            self._commands.watch()

    def _report(self) -> None:
        """Publish the diagnostics."""
        pursuit = self._pursuit
        stage = "waiting for joint_states" if self._seen is None else pursuit.stage.value
        values: dict[str, object] = {
            "stage": stage,
            "mode": self._parameters.mode,
            "samples": pursuit.samples,
            "samples_irregular": pursuit.irregular,
            "samples_limited": pursuit.limited,
            "error_rms_rad": pursuit.rms,
            "error_max_rad": pursuit.largest,
            "trajectories_refused": pursuit.refused,
            "last_refusal": pursuit.last_refusal,
        }
        doubts = [
            words
            for count, words in (
                (pursuit.irregular, "samples do not come as rate says"),
                (pursuit.limited, "torques are limited"),
                (pursuit.refused, "a trajectory was refused"),
            )
            if count
        ]
        level = DiagnosticStatus.WARN if doubts else DiagnosticStatus.OK
        name = f"{self.node.get_fully_qualified_name()}: control"
        stamp_ns = self.node.get_clock().now().nanoseconds
        said = "; ".join([stage, *doubts])
        self._diagnostics.publish(diagnostics(name, stamp_ns, level, said, values))

    def _tell(self) -> None:
        """Print how well the last motion was followed."""
        if (judged := self._pursuit.judged()) is not None:
            print(table(judged), flush=True)


def main(args: list[str] | None = None) -> int:
    """Entry point of `inverse_dynamics`."""
    return process.run("inverse_dynamics", InverseDynamics, args)


if __name__ == "__main__":
    sys.exit(main())
