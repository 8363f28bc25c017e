# SPDX-License-Identifier: Apache-2.0
"""Sensors of the simulated robot: encoders behind a channel, an IMU, a force sensor.

Each fills its message from the numbers of a state.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu

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
from sst_ros.scene.loads import JOINTS
from sst_ros.state import ZERO, Quaternion, Vector3

_KIND_COUNT = len(JOINTS) // 3  # gamma, mu, beta
_IMU_SEED = _KIND_COUNT  # the joints' noise has the seeds before it


class Numbers(NamedTuple):
    """The numbers of a state that messages are made of."""

    quaternion: Quaternion  # (x, y, z, w) of {E} in {B}
    angles: Sequence[float]  # of the nine joints, by kind and leg [rad]
    rates: Sequence[float]  # the same [rad/s]
    torque: Vector3  # of the actuators, over the step that ended [N m]
    body_rate: Vector3 = ZERO  # of the star in {E} [rad/s]
    # its derivative, where a sensor needs it [rad/s^2]
    body_acceleration: Vector3 = ZERO


class StateMessage(Protocol):
    """A message of a state, the same object each time."""

    def fill(self, stamp: Time, numbers: Numbers) -> Any:
        """Return the message; None where this sample has none."""

    def restart(self) -> None:
        """Begin anew at the first sample of a run."""


class MeasuredJointStateMessage:
    """joint_states as a robot gives them: all nine joints behind a measurement channel.

    Args:
        settings: those of the channel.
        exact: the message without the channel.

    """

    def __init__(self, settings: SimulatorParameters, exact: StateMessage) -> None:
        self._channel = settings.channel or ControlChannel()
        self._seed = settings.measurement_seed
        self._dropped_share = settings.dropped_samples
        self._exact = exact
        self.restart()

    def restart(self) -> None:
        """Restart at the first sample of a run: the same seed gives the same noise."""
        self._random = np.random.default_rng(self._seed)
        letters = range(_KIND_COUNT)
        self._angles = [
            ChannelState(self._channel, (self._seed, letter)) for letter in letters
        ]
        # Rates are only late, as the angles are: those have their noise, too.
        self._rates = [ChannelState(self._channel, 0) for letter in letters]

    def fill(self, stamp: Time, numbers: Numbers) -> Any:
        """Return the message; None for a sample that is dropped."""
        angles: list[float] = []
        rates: list[float] = []
        for letter in range(_KIND_COUNT):
            legs = slice(3 * letter, 3 * letter + 3)
            measured = self._angles[letter].measure(
                triple(numbers.angles[legs]), triple(numbers.rates[legs])
            )
            angles += self._angles[letter].transmit(measured.gamma)
            rates += self._rates[letter].transmit(measured.gamma_dot)
        if self._dropped_share and self._random.random() < self._dropped_share:
            return None
        return self._exact.fill(stamp, numbers._replace(angles=angles, rates=rates))


class ImuReading(NamedTuple):
    """Readings of an inertial measurement unit in its own axes, those of {E}."""

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
        """Restart at the first sample of a run: the same seed gives the same noise."""
        self._random = np.random.default_rng((self._seed, _IMU_SEED))
        self._late: deque[ImuReading] = deque()

    def fill(self, stamp: Time, numbers: Numbers) -> Imu:
        """Return the message."""
        reading = self._transmit(self._measure(numbers))
        message = self._message
        message.header.stamp = stamp
        orientation = message.orientation
        orientation.x, orientation.y, orientation.z, orientation.w = reading.quaternion
        _set_vector(message.angular_velocity, reading.angular_velocity)
        _set_vector(message.linear_acceleration, reading.specific_force)
        return message

    def _measure(self, numbers: Numbers) -> ImuReading:
        rate = numbers.body_rate
        point = self._position
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
        """Return the reading that arrives.

        Until the first one does, it is there already.
        """
        self._late.append(reading)
        if len(self._late) > self._delay:
            return self._late.popleft()
        return self._late[0]


class ReactionMessage:
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

    def restart(self) -> None:
        """Begin anew: there is nothing to forget."""

    def fill(self, stamp: Time, numbers: Numbers) -> WrenchStamped:
        """Return the message."""
        self._message.header.stamp = stamp
        force_x, force_y, force_z, moment_x, moment_y, moment_z = self._wrench(
            *numbers.quaternion,
            *numbers.body_rate,
            *numbers.torque,
            *numbers.body_acceleration,
        )
        _set_vector(self._message.wrench.force, (force_x, force_y, force_z))
        _set_vector(self._message.wrench.torque, (moment_x, moment_y, moment_z))
        return self._message


StateMessages: TypeAlias = dict[str, StateMessage]
"""Messages by the keys of their topics in `topics.SIMULATOR`."""


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
