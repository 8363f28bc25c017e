# SPDX-License-Identifier: Apache-2.0
"""Torques over one period: three numbers, sines, or a function of time or of time and state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from sst_ros.dynamics.traced_dynamics import Dynamics, Function, compiled
from sst_ros.integration.ode import ODE
from sst_ros.scene.loads import SineTorque
from sst_ros.state import NANOSECONDS, Joints, State, TorqueFunction, Vector3


def state_of(dynamics: Dynamics, t: float, y: Sequence[float], torque: Sequence[float]) -> State:
    """Put a state together from its numbers."""
    j = dynamics.joints(*y[:7])
    joints = Joints(j[0:3], j[3:6], j[6:9], j[9:12], j[12:15], j[15:18])  # type: ignore[arg-type]
    first, second, third = torque
    return State(
        round(t * NANOSECONDS),
        (y[0], y[1], y[2], y[3]),
        (y[4], y[5], y[6]),
        joints,
        (first, second, third),
    )


class StateFeedback:
    """Torques that are a function of time and state, evaluated in each stage of a step.

    Args:
        function: f(t, state) -> torques [N m]. In `state.torque` are the lagged torques of the
            actuators; without lag zero, for torques of this instant are what it returns.
        dynamics: of the scene.

    """

    def __init__(
        self, function: Callable[[float, State], Sequence[float]], dynamics: Dynamics
    ) -> None:
        self._function, self._dynamics = function, dynamics
        self._lag = len(dynamics.state) > 7

    def __call__(self, t: float, y: Sequence[float]) -> Vector3:
        """Torques [N m] at a time [s] and the numbers of a state."""
        lagged = y[7:10] if self._lag else (0.0, 0.0, 0.0)
        first, second, third = self._function(t, state_of(self._dynamics, t, y, lagged))
        return first, second, third


Torque = Vector3 | SineTorque | TorqueFunction | StateFeedback


class AppliedTorque:
    """Derivative of the state under a torque function, and the clamp of the actuators.

    Args:
        ode: equations whose torques are part of the drive.
        limit: largest torque of an actuator [N m], or None.
        rhs: derivative of the state in place of that of `ode`, with its inputs.

    """

    def __init__(self, ode: ODE, limit: float | None, rhs: Function | None = None) -> None:
        self._ode = ode
        self._limit = limit
        self._rhs = rhs
        self._untraced = rhs is not None
        self._torque: TorqueFunction | StateFeedback | None = None
        self._start = 0.0

    def traced(self, torque: Torque) -> Torque:
        """Return a sine torque that cannot be traced as a function; all others as they are.

        The limit of the actuators clamps it, or the derivative was given.
        """
        if not isinstance(torque, SineTorque):
            return torque
        if self._untraced:
            return sine_function(torque)
        clamped = self._limit is not None and max(map(abs, torque.amplitude)) > self._limit
        return sine_function(torque) if clamped else torque

    def begin(self, torque: Torque, start: float) -> Vector3:
        """Take the torques of a period that begins at `start` [s].

        Returns:
            Three numbers of the drive: torques [N m], phases of a sine [rad], zero for a function.

        """
        self._start = start
        if isinstance(torque, SineTorque):
            rows = zip(torque.frequency, torque.phase, strict=True)
            first, second, third = (math.fmod(f * start + p, math.tau) for f, p in rows)
            return first, second, third
        self._torque = torque if callable(torque) else None
        return (0.0, 0.0, 0.0) if callable(torque) else self.limited(torque)

    def at(self, torque: Torque, time: float, y: Sequence[float]) -> Vector3:
        """Torques that act at a time [s] and a state y, within the limit [N m]."""
        if isinstance(torque, StateFeedback):
            return self.limited(torque(time, y))
        if isinstance(torque, SineTorque):
            torque = sine_function(torque)
        return self.limited(torque(time) if callable(torque) else torque)

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
        time, function = self._start + t, self._torque
        if isinstance(function, StateFeedback):
            torque = self.limited(function(time, inputs[:size]))
        else:
            torque = self.limited(function(time))
        return self._rhs(t, *inputs[:size], *torque, *inputs[size + 3 :])


def sine_function(torque: SineTorque) -> TorqueFunction:
    """Return the torques as a function of the time [s]."""
    rows = tuple(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))

    def at(time: float) -> Vector3:
        first, second, third = (a * math.sin(f * time + p) for a, f, p in rows)
        return first, second, third

    return at
