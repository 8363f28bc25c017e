# SPDX-License-Identifier: Apache-2.0
"""What a controller is asked for: the manipulator as it should be, at any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]


@dataclass(frozen=True)
class Desired:
    """The manipulator as it should be at one instant; all parts describe the same motion.

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


class Motion(Protocol):
    """A desired motion. Before time 0 and after `duration` [s] it rests at its ends."""

    duration: float

    def at(self, time: float) -> Desired:
        """Return what is wanted at a time [s]."""
