# SPDX-License-Identifier: Apache-2.0
"""Messages of one state: numbers in message objects that are filled anew each time.

`Publisher.publish` serialises a message before it returns, so one object of each kind
serves a whole run: to make new ones would take longer than to publish them.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped, WrenchStamped
from sensor_msgs.msg import Imu, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sst_ros.control.controller import ChannelState
from sst_ros.control.law import ControlChannel
from sst_ros.mechanism.generic_math import (
    add,
    cross3,
    multiply,
    quaternion_product,
    rotate_back,
    rotation_rows,
    triple,
)
from sst_ros.runtime.settings import SimulatorParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.scene.loads import JOINTS, MOMENTS
from sst_ros.state import BASE_FRAME, NANOSECONDS, ZERO, Quaternion, Vector3

_PASSIVE = (0.0,) * (len(JOINTS) - len(ACTUATORS))
_KINDS = len(JOINTS) // 3  # gamma, mu, beta
_IMU_SEED = _KINDS  # the joints' noise has the seeds before it


class Numbers(NamedTuple):
    """The numbers of a state that messages are made of."""

    quaternion: Quaternion  # (x, y, z, w) of {E} in {B}
    angles: Sequence[float]  # of the nine joints, by kind and leg [rad]
    rates: Sequence[float]  # the same [rad/s]
    torque: Vector3  # of the actuators, over the step that ended [N m]
    body_rate: Vector3 = ZERO  # of the star in {E} [rad/s]
    body_acceleration: Vector3 = (
        ZERO  # its derivative, where a sensor needs it [rad/s^2]
    )


class StateMessage(Protocol):
    """A message of a state, the same object each time."""

    def fill(self, stamp: Time, numbers: Numbers) -> Any:
        """Return the message; None where this sample has none."""

    def restart(self) -> None:
        """Begin anew at the first sample of a run."""


class _Stateless:
    """A message that depends on the present numbers only."""

    def restart(self) -> None:
        """Begin anew at the first sample of a run: there is nothing to forget."""


def time_of(nanoseconds: int) -> Time:
    """Return a stamp."""
    seconds, rest = divmod(nanoseconds, NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


class JointStateMessage(_Stateless):
    """joint_states: all nine joints; the effort is the torque over the step that ended."""

    def __init__(self, frame_id: str = "") -> None:
        self._message = JointState(name=list(JOINTS))
        self._message.header.frame_id = frame_id

    def fill(self, stamp: Time, numbers: Numbers) -> JointState:
        """Return the message."""
        message = self._message
        message.header.stamp = stamp
        message.position = array("d", numbers.angles)
        message.velocity = array("d", numbers.rates)
        message.effort = array("d", (*numbers.torque, *_PASSIVE))
        return message


class OrientationMessage(_Stateless):
    """~/orientation: the quaternion of {E} in {B}."""

    def __init__(self, base_frame: str = BASE_FRAME) -> None:
        self._message = QuaternionStamped()
        self._message.header.frame_id = base_frame

    def fill(self, stamp: Time, numbers: Numbers) -> QuaternionStamped:
        """Return the message."""
        self._message.header.stamp = stamp
        part = self._message.quaternion
        part.x, part.y, part.z, part.w = numbers.quaternion
        return self._message


class EulerMessage(_Stateless):
    """~/euler_zyz: theta, phi and psi as x, y and z of a vector."""

    def __init__(self, base_frame: str = BASE_FRAME) -> None:
        self._message = Vector3Stamped()
        self._message.header.frame_id = base_frame

    def fill(self, stamp: Time, numbers: Numbers) -> Vector3Stamped:
        """Return the message."""
        self._message.header.stamp = stamp
        _set_vector(self._message.vector, zyz_angles(numbers.quaternion))
        return self._message


def zyz_angles(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """ZYZ angles theta, phi, psi [rad] of a quaternion (x, y, z, w), as `geometry.zyz_angles`.

    z / w is tan((theta + psi) / 2), -x / y is tan((theta - psi) / 2).
    """
    x, y, z, w = quaternion
    sine, cosine = math.hypot(x, y), math.hypot(z, w)
    total = math.atan2(z, w) if cosine else 0.0
    difference = math.atan2(-x, y) if sine else 0.0
    if sine and cosine:
        theta, psi = total + difference, total - difference
    else:
        theta, psi = 0.0, 2.0 * (total - difference)
    theta, psi = (math.remainder(angle, 2.0 * math.pi) for angle in (theta, psi))
    return theta, 2.0 * math.atan2(sine, cosine), psi


class MeasuredJointStateMessage:
    """joint_states as a robot gives them: all nine joints behind a measurement channel."""

    def __init__(self, settings: SimulatorParameters) -> None:
        self._channel = settings.channel or ControlChannel()
        self._seed = settings.measurement_seed
        self._dropped_share = settings.dropped_samples
        self._exact = JointStateMessage()
        self.restart()

    def restart(self) -> None:
        """Begin anew at the first sample of a run: the same seed gives the same noise."""
        self._random = np.random.default_rng(self._seed)
        kinds = range(_KINDS)
        self._angles = [
            ChannelState(self._channel, (self._seed, kind)) for kind in kinds
        ]
        # Rates are only late, as the angles are: those have their noise, too.
        self._rates = [ChannelState(self._channel, 0) for kind in kinds]

    def fill(self, stamp: Time, numbers: Numbers) -> JointState | None:
        """Return the message; None for a sample that is dropped."""
        angles: list[float] = []
        rates: list[float] = []
        for kind in range(_KINDS):
            legs = slice(3 * kind, 3 * kind + 3)
            measured = self._angles[kind].measure(
                triple(numbers.angles[legs]), triple(numbers.rates[legs])
            )
            angles += self._angles[kind].transmit(measured.gamma)
            rates += self._rates[kind].transmit(measured.gamma_dot)
        if self._dropped_share and self._random.random() < self._dropped_share:
            return None
        return self._exact.fill(stamp, numbers._replace(angles=angles, rates=rates))


class ImuReading(NamedTuple):
    """What an inertial measurement unit reads, in its own axes, which are those of {E}."""

    quaternion: Quaternion  # (x, y, z, w) of them in {B}
    angular_velocity: Vector3  # [rad/s]
    specific_force: Vector3  # acceleration less that of free fall [m/s^2]


class ImuMessage:
    """~/imu: an inertial measurement unit that is fixed to the star.

    By REP 145 the message is in the frame of the sensor; linear_acceleration is the
    specific force, which at rest is opposite to gravity. At a point p of the star that
    is a - g, with a = W_dot x p + W x (W x p).

    Noise and delay are those of the measurement channel, with noise of the acceleration
    beside it; the covariances are the squares of the deviations, zero without noise.

    Args:
        settings: where the sensor is, its frame, noise and delay.
        gravity: acceleration of free fall in {B} [m/s^2], None for none.

    """

    def __init__(self, settings: SimulatorParameters, gravity: Vector3 | None) -> None:
        self._position = settings.imu_position
        self._gravity = gravity or ZERO
        self._delay = settings.measurement_delay
        self._seed = settings.measurement_seed
        self._deviations = (
            settings.angle_noise,
            settings.rate_noise,
            settings.acceleration_noise,
        )
        self._message = Imu()
        self._message.header.frame_id = settings.imu_frame
        of_angle, of_rate, of_acceleration = map(_covariance, self._deviations)
        self._message.orientation_covariance = of_angle
        self._message.angular_velocity_covariance = of_rate
        self._message.linear_acceleration_covariance = of_acceleration
        self.restart()

    def restart(self) -> None:
        """Begin anew at the first sample of a run: the same seed gives the same noise."""
        self._random = np.random.default_rng((self._seed, _IMU_SEED))
        self._late: deque[ImuReading] = deque()

    def fill(self, stamp: Time, numbers: Numbers) -> Imu:
        """Return the message."""
        message, reading = self._message, self._transmit(self._measure(numbers))
        message.header.stamp = stamp
        part = message.orientation
        part.x, part.y, part.z, part.w = reading.quaternion
        _set_vector(message.angular_velocity, reading.angular_velocity)
        _set_vector(message.linear_acceleration, reading.specific_force)
        return message

    def _measure(self, numbers: Numbers) -> ImuReading:
        rate, point = numbers.body_rate, self._position
        tangential = cross3(numbers.body_acceleration, point)
        centripetal = cross3(rate, cross3(rate, point))
        free_fall = rotate_back(rotation_rows(numbers.quaternion), self._gravity)
        force = add(add(tangential, centripetal), multiply(-1.0, free_fall))
        exact = ImuReading(numbers.quaternion, rate, force)
        return self._add_noise(exact) if any(self._deviations) else exact

    def _add_noise(self, exact: ImuReading) -> ImuReading:
        """Add noise: of the orientation a small turn about each axis of the sensor."""
        rows = self._random.standard_normal((3, 3)).tolist()
        turn, rate, force = (
            multiply(deviation, triple(row))
            for deviation, row in zip(self._deviations, rows, strict=True)
        )
        return ImuReading(
            quaternion_product(exact.quaternion, _quaternion_of_turn(turn)),
            add(exact.angular_velocity, rate),
            add(exact.specific_force, force),
        )

    def _transmit(self, reading: ImuReading) -> ImuReading:
        """Return the reading that arrives; until the first one does, it is there already."""
        self._late.append(reading)
        if len(self._late) > self._delay:
            return self._late.popleft()
        return self._late[0]


class ReactionMessage(_Stateless):
    """~/reaction: what one joint exerts on the link that is nearer the star.

    Args:
        frame_id: the joint's frame, in which the wrench is given.
        wrench: force [N] and moment [N m] of quaternion, body rate, torques and angular
            acceleration, see `dynamics.reactions.reaction_at`.

    """

    def __init__(self, frame_id: str, wrench: Callable[..., Sequence[float]]) -> None:
        self._wrench = wrench
        self._message = WrenchStamped()
        self._message.header.frame_id = frame_id

    def fill(self, stamp: Time, numbers: Numbers) -> WrenchStamped:
        """Return the message."""
        self._message.header.stamp = stamp
        transmitted = self._wrench(
            *numbers.quaternion,
            *numbers.body_rate,
            *numbers.torque,
            *numbers.body_acceleration,
        )
        _set_vector(self._message.wrench.force, transmitted[:3])
        _set_vector(self._message.wrench.torque, transmitted[3:])
        return self._message


class TorqueLog:
    """applied_torques: torque and moment of every tick since the last publication.

    Point i holds over tick i; its time is the end of that tick, relative to the
    header's stamp.
    """

    def __init__(
        self, period_ns: int, *, moments: bool = False, base_frame: str = BASE_FRAME
    ) -> None:
        self._period_ns, self._moments = period_ns, moments
        names = (*ACTUATORS, *MOMENTS) if moments else ACTUATORS
        self._message = JointTrajectory(joint_names=list(names))
        self._message.header.frame_id = base_frame
        self._points: list[JointTrajectoryPoint] = []  # those of the longest log so far
        self.clear()

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Forget the rows."""
        self._rows: list[tuple[float, ...]] = []

    def append(self, torque: Vector3, moment: Sequence[float], ticks: int = 1) -> None:
        """Log the torque [N m] and the moment [N m] of some ticks."""
        self._rows += [(*torque, *moment) if self._moments else torque] * ticks

    def take(self, stamp_ns: int) -> JointTrajectory:
        """Return the message of the ticks logged since stamp_ns and clear the log."""
        for tick in range(len(self._points) + 1, len(self) + 1):
            seconds, rest = divmod(tick * self._period_ns, NANOSECONDS)
            end = Duration(sec=seconds, nanosec=rest)
            self._points.append(JointTrajectoryPoint(time_from_start=end))
        points = self._points[: len(self)]
        for point, row in zip(points, self._rows, strict=True):
            point.effort = array("d", row)
        self._message.points = points
        self._message.header.stamp = time_of(stamp_ns)
        self.clear()
        return self._message


StateMessages: TypeAlias = dict[str, StateMessage]
"""Messages by the keys of their topics in `topics.SIMULATOR`."""


def state_messages(frame_id: str = "", base_frame: str = BASE_FRAME) -> StateMessages:
    """Return the messages that each state has; the frame_id is that of joint_states."""
    return {
        "joint_states": JointStateMessage(frame_id),
        "orientation": OrientationMessage(base_frame),
        "euler_zyz": EulerMessage(base_frame),
    }


def _covariance(deviation: float) -> list[float]:
    """Return the covariance of three independent errors, row by row."""
    variance = deviation * deviation
    return [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance]


def _quaternion_of_turn(turn: Vector3) -> Quaternion:
    """Return the quaternion of a turn, axis times angle [rad]."""
    angle = math.hypot(*turn)
    scale = math.sin(0.5 * angle) / angle if angle else 0.5
    x, y, z = multiply(scale, turn)
    return x, y, z, math.cos(0.5 * angle)


def _set_vector(message: Any, numbers: Sequence[float]) -> None:
    message.x, message.y, message.z = numbers
