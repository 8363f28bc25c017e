# SPDX-License-Identifier: Apache-2.0
"""The reference of a controller at one instant, and over a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism.generic_math import ZERO, axpy, multiply
from sst_ros.state import Quaternion, Vector3


@dataclass(frozen=True)
class Reference:
    """Desired state and acceleration at one instant; all parts describe the same motion."""

    quaternion: Quaternion  # of {E} in {B}, (x, y, z, w), of length 1 up to rounding
    body_rate: Vector3  # W in {E} [rad/s]
    body_acceleration: Vector3  # W_dot in {E} [rad/s^2]
    gamma: Vector3  # of the actuators [rad]
    gamma_dot: Vector3  # [rad/s]
    gamma_ddot: Vector3  # [rad/s^2]


class ReferenceMotion:
    """A desired motion; it rests before time 0 and after `duration`.

    Args:
        inside: the reference at a time [s] from 0 to `duration`; an ArithmeticError of it is a
            serial singularity.
        pieces: times from 0 to `duration` [s], rising. From one to the next the motion is so smooth
            that some ten samples resolve it.

    Attributes:
        duration: [s].
        pieces: as given.

    """

    def __init__(self, inside: Callable[[float], Reference], pieces: tuple[float, ...]) -> None:
        self._inside, self.pieces, self.duration = inside, pieces, pieces[-1]

    def at(self, time: float) -> Reference:
        """Return the reference at a time [s]; at rest before 0 and after `duration`.

        Raises:
            SingularConfiguration: the motion meets a singularity there.

        """
        inside = min(max(time, 0.0), self.duration)
        try:
            found = self._inside(inside)
        except ArithmeticError:
            said = f"serial singularity at t = {inside:.9g} s, sin(mu)"
            raise SingularConfiguration(said, 0.0) from None
        if time == inside:
            return found
        return Reference(found.quaternion, ZERO, ZERO, found.gamma, ZERO, ZERO)


def equal_pieces(duration: float, count: int) -> tuple[float, ...]:
    """Return the ends of `count` equal parts of a duration."""
    return (*(duration * (k / count) for k in range(count)), duration)


def slow_down(motion: ReferenceMotion, begin: float, duration: float) -> ReferenceMotion:
    """Return a motion from its time `begin` [s] on, slowed down to rest over a duration > 0 [s].

    Its time s has ds/dt = 1 - 3 u^2 + 2 u^3 with u = t / duration: 1 at first and 0 at the end,
    with d^2s/dt^2 = 0 at both. It stays on the path of the given motion, which is inside all
    limits of position, for half of `duration` more at most.
    """

    def inside(time: float) -> Reference:
        u = time / duration
        at = motion.at(begin + duration * u * (1.0 - u * u * (1.0 - 0.5 * u)))
        speed = 1.0 - u * u * (3.0 - 2.0 * u)
        change = -6.0 * u * (1.0 - u) / duration
        return replace(
            at,
            body_rate=multiply(speed, at.body_rate),
            body_acceleration=axpy(speed * speed, at.body_acceleration, change, at.body_rate),
            gamma_dot=multiply(speed, at.gamma_dot),
            gamma_ddot=axpy(speed * speed, at.gamma_ddot, change, at.gamma_dot),
        )

    return ReferenceMotion(inside, equal_pieces(duration, 4))
