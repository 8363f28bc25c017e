# SPDX-License-Identifier: Apache-2.0
"""What all desired motions share: they rest before they begin and after they have ended."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

from sst_ros.control.reference import Desired, Triple

REST: Triple = (0.0, 0.0, 0.0)


class PlannedMotion(ABC):
    """A motion that can be checked before it starts.

    Attributes:
        duration: how long it takes [s].
        pieces: times from 0 to `duration` [s], rising. From one to the next the motion is a smooth
            arc without wiggles, so that some ten samples show its course.

    """

    def __init__(self, duration: float, pieces: tuple[float, ...]) -> None:
        self.duration = duration
        self.pieces = pieces

    def at(self, time: float) -> Desired:
        """Return what is wanted at a time [s]; at rest before 0 and after `duration`.

        Raises:
            SingularConfiguration: the motion meets a singularity there.

        """
        if 0.0 <= time <= self.duration:
            return self._inside(time)
        end = self._inside(0.0 if time < 0.0 else self.duration)
        return replace(end, body_rate=REST, body_acceleration=REST, gamma_dot=REST, gamma_ddot=REST)

    @abstractmethod
    def _inside(self, time: float) -> Desired:
        """Return what is wanted at a time [s] between 0 and `duration`."""


def parts(duration: float, count: int) -> tuple[float, ...]:
    """Return the ends of `count` equal parts of a duration."""
    return (*(duration * (k / count) for k in range(count)), duration)
