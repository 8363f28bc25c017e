# SPDX-License-Identifier: Apache-2.0
"""Rigid ends of the stroke: impacts with restitution, and rest against an end.

A torque at actuator k changes W_dot by M^-1 g_k; an impulse there changes W by the same vector, so
both follow from the direct dynamics, and no other generalized momentum changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.compiled import Dynamics

Vector = tuple[float, ...]
Array = NDArray[np.float64]


class RigidEnds:
    """Contact at the ends of the stroke of one scene."""

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics = dynamics

    def after_impact(self, y: Vector, leg: int, restitution: float) -> Vector:
        """Return the state after the actuator of `leg` (0 to 2) has hit its end.

        Args:
            y: state before.
            leg: which actuator.
            restitution: - rate after / rate before.

        """
        g, _ = self._reach(y)
        m_g, rate = self._response(y, [leg])[:, 0], np.array(y[4:7])
        impulse = -(1.0 + restitution) * float(g[leg] @ rate) / float(g[leg] @ m_g)
        return (*y[:4], *(rate + impulse * m_g).tolist(), *y[7:])

    def held(self, y: Vector, slope: Sequence[float], legs: list[int]) -> tuple[Vector, Array]:
        """Hold `legs` still: the derivative of the state, and the torques of the ends [N m].

        Args:
            y: state.
            slope: derivative of the state without the ends.
            legs: the actuators that rest against an end; the torques come in their order.

        """
        g, rest = self._reach(y)
        m_g = self._response(y, legs)
        free = g[legs] @ np.array(slope[4:7]) + rest[legs]
        torques = np.linalg.solve(g[legs] @ m_g, -free)
        turned = np.array(slope[4:7]) + m_g @ torques
        return (*slope[:4], *turned.tolist(), *slope[7:]), torques

    def _reach(self, y: Vector) -> tuple[Array, Array]:
        """Rows g_k, gamma_dot = g W, and gamma_ddot at W_dot = 0; shapes (3, 3) and (3,)."""
        flat = np.array(self._dynamics.reach(*y[:7]))
        return flat[:9].reshape(3, 3), flat[9:]

    def _response(self, y: Vector, legs: list[int]) -> Array:
        """M^-1 g_k of the legs, columns, shape (3, n)."""
        at = self._dynamics.acceleration
        rest = np.array(at(*y[:7], 0.0, 0.0, 0.0))
        units = np.eye(3).tolist()
        return np.stack([np.array(at(*y[:7], *units[leg])) - rest for leg in legs], axis=1)
