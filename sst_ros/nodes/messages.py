# SPDX-License-Identifier: Apache-2.0
"""Messages of the simulator, built once; afterwards only their numbers are written."""

from __future__ import annotations

import math
from collections.abc import Sequence

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.errors import SstError
from sst_ros.nodes.raw_messages import Template, Write, marks
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.simulation import NANOSECONDS, State

JOINTS = [*ACTUATORS, "mu_1", "mu_2", "mu_3", "beta_1", "beta_2", "beta_3"]
MOMENTS = ["moment_x", "moment_y", "moment_z"]
BASE_FRAME = "base"
_NO_JOINTS = (0.0,) * len(JOINTS)


class NotFinite(SstError):
    """A state with a number in it that is none; it is not published."""


class StateMessages:
    """joint_states, orientation and euler_zyz of one instant.

    Attributes:
        templates: of these three messages, in this order.

    """

    def __init__(self) -> None:
        count = len(JOINTS)
        position, velocity, effort = (marks(count, k * count) for k in range(3))
        quaternion, angles = marks(4), marks(3)
        joints = JointState(name=JOINTS, position=position, velocity=velocity, effort=effort)
        orientation, euler = QuaternionStamped(), Vector3Stamped()
        orientation.header.frame_id = euler.header.frame_id = BASE_FRAME
        q, vector = orientation.quaternion, euler.vector
        q.x, q.y, q.z, q.w = quaternion
        vector.x, vector.y, vector.z = angles
        self.templates = Template(joints), Template(orientation), Template(euler)
        first, second, third = self.templates
        places = (first.place(values) for values in (position, velocity, effort))
        self._position, self._velocity, self._effort = places
        self._quaternion, self._angles = second.place(quaternion), third.place(angles)
        for write in (self._position, self._velocity, self._effort):
            write(*_NO_JOINTS)

    def fill(self, state: State) -> None:
        """Take over a state; the effort is the torque over the step that ended at it.

        Raises:
            NotFinite: nothing has been taken over.

        """
        gamma, mu, beta, gamma_dot, mu_dot, beta_dot = state.joints
        angles = gamma + mu + beta
        rates = gamma_dot + mu_dot + beta_dot
        # One number that is not finite makes the sum so.
        if not math.isfinite(sum(angles + rates + state.quaternion + state.torque)):
            raise NotFinite(f"a state that is not finite is not published: {state}")
        self._position(*angles)
        self._velocity(*rates)
        self._effort(*state.torque, *_NO_JOINTS[3:])
        self._quaternion(*state.quaternion)
        self._angles(*zyz_of(state.quaternion))

    def still(self) -> None:
        """Set all rates and efforts to zero: a state that is held."""
        self._velocity(*_NO_JOINTS)
        self._effort(*_NO_JOINTS)


def zyz_of(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """ZYZ angles of a quaternion (x, y, z, w), as `frames.zyz_angles` has them, of plain floats.

    z / w is tan((theta + psi) / 2), -x / y is tan((theta - psi) / 2).
    """
    x, y, z, w = quaternion
    aside, along = math.hypot(x, y), math.hypot(z, w)
    total = math.atan2(z, w) if along else 0.0
    difference = math.atan2(-x, y) if aside else 0.0
    if not (aside and along):
        theta, psi = 0.0, 2.0 * (total - difference)
    else:
        theta, psi = total + difference, total - difference
    return _wrapped(theta), 2.0 * math.atan2(aside, along), _wrapped(psi)


def _wrapped(angle: float) -> float:
    """In (-pi, pi], as atan2 gives it."""
    if angle > math.pi:
        return angle - 2.0 * math.pi
    return angle if angle > -math.pi else angle + 2.0 * math.pi


class TorqueLog:
    """applied_torques: what acted over every tick since the last publication.

    Point i holds over tick i and says when that tick ends, relative to the header's stamp.
    """

    def __init__(self, usual: int, period_ns: int, *, moments: bool = False) -> None:
        self._names = [*ACTUATORS, *(MOMENTS if moments else ())]
        self._period_ns, self._moments = period_ns, moments
        self._rows: list[tuple[float, ...]] = []
        # One for each number of ticks: mostly the usual one, none where there is no run.
        self._forms = {count: self._form(count) for count in (0, usual)}

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Forget what was noted."""
        self._rows.clear()

    def append(self, torque: Sequence[float], moment: Sequence[float], ticks: int = 1) -> None:
        """Note the torque and the moment of a tick, or of several."""
        row = (*torque, *moment) if self._moments else tuple(torque)
        self._rows.extend([row] * ticks)

    def take(self, stamp_ns: int) -> bytes:
        """Return the message of the ticks noted since stamp_ns and begin anew."""
        count = len(self._rows)
        if count not in self._forms:
            self._forms[count] = self._form(count)
        template, places = self._forms[count]
        for write, row in zip(places, self._rows, strict=True):
            write(*row)
        self._rows.clear()
        return template.stamped(stamp_ns)

    def _form(self, count: int) -> tuple[Template, list[Write]]:
        size = len(self._names)
        efforts = [marks(size, i * size) for i in range(count)]
        message = JointTrajectory(joint_names=self._names)
        message.header.frame_id = BASE_FRAME
        for i, effort in enumerate(efforts):
            sec, nanosec = divmod((i + 1) * self._period_ns, NANOSECONDS)
            after = Duration(sec=sec, nanosec=nanosec)
            message.points.append(JointTrajectoryPoint(effort=effort, time_from_start=after))
        template = Template(message)
        return template, [template.place(effort) for effort in efforts]


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
