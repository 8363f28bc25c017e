# SPDX-License-Identifier: Apache-2.0
"""The regressor of the inverse dynamics: torque = known part + Y parameters.

Torques are linear in the inertial parameters, the friction coefficients, the stiffness of springs
and the inertia of the rotors (Atkeson, An and Hollerbach, Int. J. Robotics Research 5 (1986)
101-119). So Y is the derivative of the traced inverse dynamics by these parameters, which has no
parameter in it: the regressor is exact, and covers each term that the dynamics have.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Expression, Program, with_jacobian
from sst_ros.dynamics.traced_dynamics import (
    BODY_ACCELERATION,
    QUATERNION,
    RATE,
    compile_for_arrays,
)
from sst_ros.identification.parameters import with_symbols
from sst_ros.integration.parametric_model import VariedNumber
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene


class Regressor:
    """Y and the known part of the torques of a scene.

    Args:
        scene: the manipulator; what is not among the parameters is known.
        names: the parameters, see `parameters`.

    """

    def __init__(self, scene: Scene, names: Sequence[str]) -> None:
        self.scene, self.names = scene, tuple(names)
        self._geometry = Geometry.of(scene)
        self._traced = [n for n in self.names if not n.startswith("offset") and n[-5:] != ".mass"]

    @cached_property
    def program(self) -> Program:
        """Three torques, then their derivatives by each parameter of the dynamics."""
        symbols = tuple(f"p{i}" for i in range(len(self._traced)))
        return with_jacobian(
            self._torques, (*QUATERNION, *RATE, *BODY_ACCELERATION, *symbols), symbols
        )

    def __call__(self, quaternion: Array, rate: Array, acceleration: Array) -> tuple[Array, Array]:
        """Evaluate at n states.

        Args:
            quaternion: of {E} in {B}, (x, y, z, w), shape (n, 4).
            rate: W in {E} [rad/s], shape (n, 3).
            acceleration: W_dot in {E} [rad/s^2], shape (n, 3).

        Returns:
            The known torques [N m], shape (n, 3), and Y, shape (n, 3, len(names)).

        """
        count = len(quaternion)
        states = (*quaternion.T, *rate.T, *acceleration.T)
        # A stiffness of zero leaves no rest angle: springs are evaluated at 1 N m/rad.
        at = [float(name.startswith("springs")) for name in self._traced]
        found = self._function(*states, *at)
        rows = [np.broadcast_to(row, (count,)) for row in found]
        columns = np.zeros((count, 3, len(self.names)))
        for i, name in enumerate(self._traced):
            part = np.stack(rows[3 * i + 3 : 3 * i + 6], axis=1)
            columns[:, :, self.names.index(name)] = part
        for i, name in enumerate(self.names):
            if name.startswith("offset"):
                columns[:, int(name[7]), i] = 1.0
        springs = [name.startswith("springs") for name in self.names]
        return np.stack(rows[:3], axis=1) - columns[:, :, springs].sum(axis=2), columns

    @cached_property
    def _function(self) -> Any:
        return compile_for_arrays(self.program)

    def _torques(self, *inputs: Any) -> tuple[Any, ...]:
        varied = [present(symbol) for symbol in inputs[10:]]
        opened = with_symbols(
            self.scene, dict(zip(self._traced, varied, strict=True)), moments=True
        )
        model = kernel.model_of(opened, self._geometry)
        torque, _ = kernel.actuator_torque(model, inputs[:4], inputs[4:7], inputs[7:10])
        return torque


def present(symbol: Expression) -> VariedNumber:
    """Return an expression that counts as not zero, so that no term of it is left out."""
    return VariedNumber(symbol.graph, symbol.index)
