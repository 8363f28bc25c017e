# SPDX-License-Identifier: Apache-2.0
"""A system under torques that are three numbers over a period, or a function of time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sst_ros.dynamics.traced_dynamics import compiled
from sst_ros.integration.ode import System

if TYPE_CHECKING:
    from sst_ros.simulation import Torque, Triple

Vector = Sequence[float]
Free = Callable[[float, Vector], Vector]
"""Derivative of the state by time, at a time and a state, as if there were no rigid ends."""


class Driven:
    """The system as plain Python drives it.

    Args:
        system: what is integrated.
        limit: largest torque of an actuator [N m], or None.

    """

    def __init__(self, system: System, limit: float | None) -> None:
        self._system = system
        self._limit = limit
        self._rhs: Callable[..., tuple[float, ...]] | None = None
        self._torque: Callable[[float], Triple] | None = None
        self._start = 0.0

    @property
    def by_function(self) -> bool:
        """Whether the torques are a function of time now."""
        return self._torque is not None

    def begin(self, torque: Torque, start: float) -> tuple[float, ...]:
        """Take the torques of a period whose time zero is `start` [s]; return them as a drive."""
        self._torque = torque if callable(torque) else None
        self._start = start
        return (0.0,) * 3 if callable(torque) else self.limited(torque)

    def limited(self, torque: Triple) -> Triple:
        """Clamp torques to the limit of the actuators."""
        if self._limit is None:
            return torque
        limit, (first, second, third) = self._limit, torque
        return (
            min(max(first, -limit), limit),
            min(max(second, -limit), limit),
            min(max(third, -limit), limit),
        )

    def slope(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state; inputs are its numbers, then those of the drive."""
        if self._rhs is None:
            self._rhs = compiled(self._system.program)
        if self._torque is not None:
            size = len(self._system.state)
            torque = self.limited(self._torque(self._start + t))
            inputs = (*inputs[:size], *torque, *inputs[size + 3 :])
        return self._rhs(t, *inputs)

    def free(self, drive: Vector) -> Free:
        """Return the derivative under a drive."""
        return lambda t, y: self.slope(t, *y, *drive)
