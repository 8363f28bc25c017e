# SPDX-License-Identifier: Apache-2.0
"""Messages of the simulator, built once and filled in place."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.mechanism.frames import rotation_matrix, zyz_angles
from sst_ros.nodes.commands import ACTUATORS
from sst_ros.simulation import NANOSECONDS, State

JOINTS = [*ACTUATORS, "mu_1", "mu_2", "mu_3", "beta_1", "beta_2", "beta_3"]
MOMENTS = ["moment_x", "moment_y", "moment_z"]
BASE_FRAME = "base"


class StateMessages:
    """joint_states, orientation and euler_zyz of one instant."""

    def __init__(self) -> None:
        self.joint_states = JointState(name=JOINTS)
        for field in ("position", "velocity", "effort"):
            setattr(self.joint_states, field, array("d", [0.0] * len(JOINTS)))
        self.orientation, self.euler_zyz = QuaternionStamped(), Vector3Stamped()
        self.orientation.header.frame_id = self.euler_zyz.header.frame_id = BASE_FRAME
        self._stamps = [
            message.header.stamp
            for message in (self.joint_states, self.orientation, self.euler_zyz)
        ]

    def fill(self, state: State, stamp_ns: int) -> None:
        """Take over a state; the effort is the torque over the step that ended at it."""
        for stamp in self._stamps:
            set_time(stamp, stamp_ns)
        at, message = state.joints, self.joint_states
        for k in range(3):
            message.position[k], message.velocity[k] = at.gamma[k], at.gamma_dot[k]
            message.position[k + 3], message.velocity[k + 3] = at.mu[k], at.mu_dot[k]
            message.position[k + 6], message.velocity[k + 6] = at.beta[k], at.beta_dot[k]
            message.effort[k] = state.torque[k]
        q, vector = self.orientation.quaternion, self.euler_zyz.vector
        q.x, q.y, q.z, q.w = state.quaternion
        theta, phi, psi = zyz_angles(rotation_matrix(state.quaternion)).tolist()
        vector.x, vector.y, vector.z = theta, phi, psi

    def still(self) -> None:
        """Set all rates and efforts to zero: a state that is held."""
        for k in range(len(JOINTS)):
            self.joint_states.velocity[k] = self.joint_states.effort[k] = 0.0


class TorqueLog:
    """applied_torques: what acted over every tick since the last publication.

    Point i holds over tick i and says when that tick ends, relative to the header's stamp.
    """

    def __init__(self, ticks: int, period_ns: int, *, moments: bool = False) -> None:
        names = [*ACTUATORS, *(MOMENTS if moments else ())]
        self.message = JointTrajectory(joint_names=names)
        self.message.header.frame_id = BASE_FRAME
        self._moments = moments
        self._points = [
            JointTrajectoryPoint(
                effort=array("d", [0.0] * len(names)),
                time_from_start=Duration(
                    sec=(i + 1) * period_ns // NANOSECONDS,
                    nanosec=(i + 1) * period_ns % NANOSECONDS,
                ),
            )
            for i in range(ticks)
        ]
        self.count = 0

    def append(self, torque: Sequence[float], moment: Sequence[float]) -> None:
        """Note the torque and the moment of one tick."""
        effort = self._points[self.count].effort
        effort[0], effort[1], effort[2] = torque
        if self._moments:
            effort[3], effort[4], effort[5] = moment
        self.count += 1

    def take(self, stamp_ns: int) -> JointTrajectory:
        """Return the message of the ticks noted since stamp_ns and begin anew."""
        set_time(self.message.header.stamp, stamp_ns)
        self.message.points = self._points[: self.count]
        self.count = 0
        return self.message


def diagnostics(
    name: str, stamp_ns: int, level: bytes, said: str, values: dict[str, object]
) -> DiagnosticArray:
    """Build a DiagnosticArray of one status."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    status = DiagnosticStatus(level=level, name=name, message=said, hardware_id="", values=pairs)
    message = DiagnosticArray(status=[status])
    set_time(message.header.stamp, stamp_ns)
    return message


def set_time(stamp: Time, nanoseconds: int) -> None:
    """Write integer nanoseconds into a message's time."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def nanoseconds(stamp: Time) -> int:
    """Read a message's time as integer nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
