# SPDX-License-Identifier: Apache-2.0
"""The functions of one scene that a run calls: traced, flat, with nothing the scene has not."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from sst_ros.dynamics import energy, kernel
from sst_ros.dynamics.expression import Program, trace
from sst_ros.mechanism.vec3 import rotation_rows
from sst_ros.scene.scene import Scene

FUNCTIONS = ("sqrt", "tanh", "exp", "sin", "cos", "atan2")
Function = Callable[..., tuple[float, ...]]

QUATERNION = ("x", "y", "z", "w")
RATE = ("wx", "wy", "wz")
LAG = ("l1", "l2", "l3")
TORQUE = ("t1", "t2", "t3")
MOMENT = ("n1", "n2", "n3")
BODY_ACCELERATION = ("ax", "ay", "az")

_MOST_RECENT = 32


class Dynamics:
    """Programs of a manipulator.

    Args:
        model: its constants, numbers or not.
        moved: by a moment that comes from a topic.

    Attributes:
        model, moved: as given.
        state: names of the state's numbers: quaternion, body rate, lagged torques if any.
        drive: names of what acts from outside: torques, and a moment if it comes from a topic.

    """

    def __init__(self, model: kernel.Model, *, moved: bool = False) -> None:
        self.model, self.moved = model, moved
        lagging = model.time_constant is not None
        self.state = (*QUATERNION, *RATE, *(LAG if lagging else ()))
        self.drive = (*TORQUE, *(MOMENT if moved else ()))

    @staticmethod
    def of(scene: Scene) -> Dynamics:
        """Give those of a scene: traced once for all scenes that have the same constants."""
        moved = scene.moment is not None and scene.moment.topic
        return recent(kernel.model_of(scene), moved=moved)

    @cached_property
    def program(self) -> Program:
        """Derivative of the state by time; inputs are state and drive."""
        return trace(self._derivative, (*self.state, *self.drive))

    @cached_property
    def derivative(self) -> Function:
        """The program as a function of plain floats."""
        return compiled(self.program)

    @cached_property
    def joints(self) -> Function:
        """Angles gamma, mu, beta and rates in the same order, 18 numbers of the first seven."""
        return compiled(self.joints_program)

    @cached_property
    def joints_program(self) -> Program:
        """The program of `joints`."""
        return trace(self._joints, (*QUATERNION, *RATE))

    @cached_property
    def inverse(self) -> Function:
        """Torques that give a W_dot, det g and sin^2(mu_k), 7 numbers: `kernel.actuator_torque`.

        Of the first seven numbers of the state, W_dot, and a moment if it comes from a topic.
        """
        more = MOMENT if self.moved else ()
        return compiled(trace(self._inverse, (*QUATERNION, *RATE, *BODY_ACCELERATION, *more)))

    @cached_property
    def reach(self) -> Function:
        """Rows g_k (nine numbers) and gamma_ddot at W_dot = 0, of the first seven numbers."""
        return compiled(trace(self._reach, (*QUATERNION, *RATE)))

    @cached_property
    def energies(self) -> Function:
        """Kinetic and potential energy [J] and power put in [W], of state and drive."""
        return compiled(trace(self._energies, (*self.state, *self.drive)))

    def _derivative(self, *inputs: Any) -> tuple[Any, ...]:
        return kernel.derivative(self.model, *self._split(inputs))

    def _joints(self, *state: Any) -> tuple[Any, ...]:
        return tuple(number for triple in kernel.joints(self.model, state) for number in triple)

    def _inverse(self, *inputs: Any) -> tuple[Any, ...]:
        q, rate, acceleration, moment = inputs[:4], inputs[4:7], inputs[7:10], inputs[10:] or None
        torque, determinant = kernel.actuator_torque(self.model, q, rate, acceleration, moment)
        rows = rotation_rows(q)
        squares = (kernel.leg_motion(leg, rows, rate).u for leg in self.model.legs)
        return (*torque, determinant, *squares)

    def _reach(self, *state: Any) -> tuple[Any, ...]:
        rows, rate = rotation_rows(state[:4]), state[4:7]
        legs = [kernel.leg_motion(leg, rows, rate) for leg in self.model.legs]
        flat = [number for at in legs for number in at.g]
        return (*flat, *(kernel.rest_accelerations(at, rate)[1] for at in legs))

    def _energies(self, *inputs: Any) -> tuple[Any, ...]:
        state, torque, moment = self._split(inputs)
        stored = energy.kinetic(self.model, state), energy.potential(self.model, state)
        return (*stored, energy.power(self.model, state, torque, moment))

    def _split(self, inputs: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        size = len(self.state)
        return inputs[:size], inputs[size : size + 3], inputs[size + 3 :] or None


recent = lru_cache(maxsize=_MOST_RECENT)(Dynamics)


def compiled(program: Program) -> Function:
    """Turn a program into a Python function of its inputs.

    The function raises ArithmeticError or ValueError where a float has no value.
    """
    names: dict[str, Any] = {name: getattr(math, name) for name in FUNCTIONS}
    exec(program.source("function"), names)
    function: Function = names["function"]
    return function


def compiled_for_arrays(program: Program) -> Callable[..., tuple[Any, ...]]:
    """Turn a program into a function of NumPy arrays, element by element."""
    names: dict[str, Any] = {name: getattr(np, name) for name in FUNCTIONS if name != "atan2"}
    names |= {"atan2": np.arctan2, "max": np.maximum}
    exec(program.source("function"), names)
    function: Callable[..., tuple[Any, ...]] = names["function"]
    return function
