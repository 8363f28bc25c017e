# SPDX-License-Identifier: Apache-2.0
"""A motion that comes to rest along its own path."""

from __future__ import annotations

from sst_ros.control.reference import Reference, ReferenceMotion, Triple, equal_pieces
from sst_ros.mechanism.generic_math import axpy, scaled


class StoppingMotion(ReferenceMotion):
    """Another motion from a time on, slowed down to rest by time scaling.

    Its time s has ds/dt = 1 - 3 u^2 + 2 u^3 with u = t / duration: 1 at first and 0 at the end,
    with d^2s/dt^2 = 0 at both. It stays on the path of the other motion, which is inside all
    limits of position, for half of `duration` more at most.

    Args:
        motion: the other motion.
        begin: its time from which it is slowed down [s].
        duration: time until it rests [s], > 0.

    """

    def __init__(self, motion: ReferenceMotion, begin: float, duration: float) -> None:
        super().__init__(duration, equal_pieces(duration, 4))
        self._motion, self._begin = motion, begin

    def _inside(self, time: float) -> Reference:
        u = time / self.duration
        at = self._motion.at(self._begin + self.duration * u * (1.0 - u * u * (1.0 - 0.5 * u)))
        speed = 1.0 - u * u * (3.0 - 2.0 * u)
        change = -6.0 * u * (1.0 - u) / self.duration

        def second(rate: Triple, acceleration: Triple) -> Triple:
            return axpy(speed * speed, acceleration, change, rate)

        return Reference(
            at.quaternion,
            scaled(speed, at.body_rate),
            second(at.body_rate, at.body_acceleration),
            at.gamma,
            scaled(speed, at.gamma_dot),
            second(at.gamma_dot, at.gamma_ddot),
        )
