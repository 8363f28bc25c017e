# SPDX-License-Identifier: Apache-2.0
"""The reference of a controller, and reference motions: a reference for every time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]

REST: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Reference:
    """Desired state and acceleration at one instant; all parts describe the same motion.

    Attributes:
        quaternion: of {E} in {B}, (x, y, z, w), of length 1 up to rounding.
        body_rate: W in {E} [rad/s].
        body_acceleration: W_dot in {E} [rad/s^2].
        gamma, gamma_dot, gamma_ddot: actuators [rad], [rad/s], [rad/s^2].

    """

    quaternion: Quadruple
    body_rate: Triple
    body_acceleration: Triple
    gamma: Triple
    gamma_dot: Triple
    gamma_ddot: Triple


class ReferenceMotion(ABC):
    """A desired motion; it rests before time 0 and after `duration`.

    Attributes:
        duration: [s].
        pieces: times from 0 to `duration` [s], rising. From one to the next the motion is so smooth
            that some ten samples resolve it.

    """

    def __init__(self, duration: float, pieces: tuple[float, ...]) -> None:
        self.duration = duration
        self.pieces = pieces

    def at(self, time: float) -> Reference:
        """Return the reference at a time [s]; at rest before 0 and after `duration`.

        Raises:
            SingularConfiguration: the motion meets a singularity there.

        """
        if 0.0 <= time <= self.duration:
            return self._inside(time)
        end = self._inside(0.0 if time < 0.0 else self.duration)
        return replace(end, body_rate=REST, body_acceleration=REST, gamma_dot=REST, gamma_ddot=REST)

    @abstractmethod
    def _inside(self, time: float) -> Reference:
        """Return the reference at a time [s] between 0 and `duration`."""


def equal_pieces(duration: float, count: int) -> tuple[float, ...]:
    """Return the ends of `count` equal parts of a duration."""
    return (*(duration * (k / count) for k in range(count)), duration)
