# SPDX-License-Identifier: Apache-2.0
"""Torques over one period: three numbers, sines, or a function of time or of time and state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from sst_ros.dynamics.traced_dynamics import ODE, Dynamics, Function, compile_program
from sst_ros.scene.loads import SineTorque
from sst_ros.state import NANOSECONDS, State, TorqueFunction, Vector3, clamp


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
        lagged = (y[7], y[8], y[9]) if self._lag else (0.0, 0.0, 0.0)
        state = State.of(round(t * NANOSECONDS), y, self._dynamics.joints(*y[:7]), lagged)
        first, second, third = self._function(t, state)
        return first, second, third


Torque = Vector3 | SineTorque | TorqueFunction | StateFeedback


class AppliedTorque:
    """Derivative of the state under a torque function, and the clamp of the actuators.

    Args:
        ode: equations whose torques are part of the drive.
        limit: largest torque of an actuator [N m], or None.
        rhs: derivative of the state in place of that of `ode`, with its inputs.

    Attributes:
        limit: as given.

    """

    def __init__(self, ode: ODE, limit: float | None, rhs: Function | None = None) -> None:
        self._ode, self.limit, self._rhs = ode, limit, rhs
        self._traced = rhs is None
        self._torque: TorqueFunction | StateFeedback | None = None
        self._start = 0.0

    def acting(self, torque: Torque) -> Torque:
        """Return what acts: numbers within the limit of the actuators; functions as they are.

        A sine becomes a function where it is no part of the program: the actuators clamp it, or
        the derivative was given.
        """
        if isinstance(torque, SineTorque):
            return torque if self._traced and self.limit_of(torque) is None else torque.at
        if callable(torque):
            return torque
        first, second, third = torque
        return clamp((first, second, third), self.limit)

    def limit_of(self, torque: SineTorque) -> float | None:
        """Return the limit of the actuators where it clamps a sine [N m]."""
        limit = self.limit
        return None if limit is None or max(map(abs, torque.amplitude)) <= limit else limit

    def begin(self, torque: Torque, start: float) -> Vector3:
        """Take the sine or function of a period that begins at `start` [s].

        Returns:
            Three numbers of the drive: phases of the sine [rad], zero for a function.

        """
        if isinstance(torque, SineTorque):
            rows = zip(torque.frequency, torque.phase, strict=True)
            first, second, third = (math.fmod(f * start + p, math.tau) for f, p in rows)
            return first, second, third
        assert callable(torque)
        self._torque, self._start = torque, start
        return (0.0, 0.0, 0.0)

    def at(self, torque: Torque, time: float, y: Sequence[float]) -> Vector3:
        """Torques that act at a time [s] and a state y, within the limit [N m]."""
        if isinstance(torque, StateFeedback):
            torque = torque(time, y)
        elif isinstance(torque, SineTorque):
            torque = torque.at(time)
        return clamp(torque(time) if callable(torque) else torque, self.limit)

    def derivative(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state by time; inputs are its numbers, then those of the drive."""
        if self._rhs is None:
            self._rhs = compile_program(self._ode.program)
        assert self._torque is not None
        size = len(self._ode.state)
        torque = self.at(self._torque, self._start + t, inputs[:size])
        return self._rhs(t, *inputs[:size], *torque, *inputs[size + 3 :])
