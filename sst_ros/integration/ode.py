# SPDX-License-Identifier: Apache-2.0
"""What is integrated: the derivative of a scene's state by time, traced."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from sst_ros.dynamics import energy, kernel
from sst_ros.dynamics.expression import Program, trace, with_jacobian
from sst_ros.dynamics.math_functions import positive, sin
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, compiled
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import SineTorque


class ODE:
    """Derivative of a scene's state, as programs with the inputs t, state, drive.

    Args:
        dynamics: the scene.
        torque: torques over time that replace those of the drive; the drive is then what else
            acts from outside, or nothing.
        limit: of the actuators, which clamps `torque` [N m].
        phases: the drive keeps three numbers for the torques: the phases [rad] of `torque`.
        work: append to the state the work [J] that actuators and moments have put in, less what
            friction has taken out.

    Attributes:
        state: names of the state's numbers: quaternion, body rate, lagged torques, work.
        drive: names of the drive's numbers, which are constant over a step.

    """

    def __init__(
        self,
        dynamics: Dynamics,
        torque: SineTorque | None = None,
        *,
        limit: float | None = None,
        work: bool = False,
        phases: bool = False,
    ) -> None:
        self._dynamics = dynamics
        self._torque = torque
        self._limit = limit
        self._work = work
        self._phases = phases
        self.state = (*dynamics.state, *(("work",) if work else ()))
        self.drive = dynamics.drive if torque is None or phases else dynamics.drive[3:]

    @cached_property
    def program(self) -> Program:
        """The derivative."""
        return trace(self.derivative, self._inputs)

    @cached_property
    def jacobian(self) -> Program:
        """The derivative, and its derivatives by t and by each number of the state."""
        return with_jacobian(self.derivative, self._inputs, ("t", *self.state))

    def eigenvalues(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Eigenvalues of the exact Jacobian at time [s], state and drive [1/s], shape (size,).

        Raises:
            ArithmeticError, ValueError: it is not finite.

        """
        size = len(self.state)
        flat = np.array(self._linearised(t, *y, *d)[2 * size :])
        return np.asarray(np.linalg.eigvals(flat.reshape(size, size).T))

    @cached_property
    def _linearised(self) -> Function:
        return compiled(self.jacobian)

    @property
    def joints(self) -> Program:
        """Nine angles and nine rates, of quaternion and body rate."""
        return self._dynamics.joints_program

    @property
    def _inputs(self) -> tuple[str, ...]:
        return ("t", *self.state, *self.drive)

    def derivative(self, time: Any, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative at the time, the state and the drive given, of any kind."""
        size = len(self._dynamics.state)
        state, drive = inputs[:size], inputs[len(self.state) :]
        torque, rest = drive[:3], drive[3:]
        if self._torque is not None:
            phase = torque if self._phases else self._torque.phase
            rows = zip(self._torque.amplitude, self._torque.frequency, phase, strict=True)
            torque = tuple(a * sin(f * time + p) for a, f, p in rows)
            if self._limit is not None:
                torque = tuple(_clamped(tau, self._limit) for tau in torque)
            rest = rest if self._phases else drive
        moment = (rest[0], rest[1], rest[2]) if rest else None
        model = self._dynamics.model
        slope = kernel.derivative(model, state, torque, moment)
        if not self._work:
            return slope
        return (*slope, energy.power(model, state, torque, moment))


def _clamped(torque: Any, limit: float) -> Any:
    """Clamp a torque, of any kind of number."""
    return limit - positive(2.0 * limit - positive(torque + limit))


@lru_cache(maxsize=32)
def ode_with_work(dynamics: Dynamics) -> ODE:
    """Give the system that counts work: traced once for all runs of the same dynamics."""
    return ODE(dynamics, work=True)
