# SPDX-License-Identifier: Apache-2.0
"""Torques over one period: three numbers, or a function of time in plain Python."""

from __future__ import annotations

from typing import Any

from sst_ros.dynamics.traced_dynamics import Function, compiled
from sst_ros.integration.ode import ODE
from sst_ros.state import TorqueFunction, Vector3


class AppliedTorque:
    """Derivative of the state under a torque function, and the clamp of the actuators.

    Args:
        ode: equations whose torques are part of the drive.
        limit: largest torque of an actuator [N m], or None.

    """

    def __init__(self, ode: ODE, limit: float | None) -> None:
        self._ode = ode
        self._limit = limit
        self._rhs: Function | None = None
        self._torque: TorqueFunction | None = None
        self._start = 0.0

    @property
    def is_function(self) -> bool:
        """Whether the torques of this period are a function of time."""
        return self._torque is not None

    def begin(self, torque: Vector3 | TorqueFunction, start: float) -> Vector3:
        """Take the torques of a period that begins at `start` [s]; return them as a drive."""
        self._torque = torque if callable(torque) else None
        self._start = start
        return (0.0, 0.0, 0.0) if callable(torque) else self.limited(torque)

    def limited(self, torque: Vector3) -> Vector3:
        """Clamp torques [N m] to the limit of the actuators."""
        if self._limit is None:
            return torque
        limit, (first, second, third) = self._limit, torque
        return (
            min(max(first, -limit), limit),
            min(max(second, -limit), limit),
            min(max(third, -limit), limit),
        )

    def derivative(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state by time; inputs are its numbers, then those of the drive."""
        if self._rhs is None:
            self._rhs = compiled(self._ode.program)
        assert self._torque is not None
        size = len(self._ode.state)
        torque = self.limited(self._torque(self._start + t))
        return self._rhs(t, *inputs[:size], *torque, *inputs[size + 3 :])
