# SPDX-License-Identifier: Apache-2.0
"""Rigid ends of the stroke: impacts with restitution, and rest against an end.

A torque at actuator k changes W_dot by M^-1 g_k; an impulse there changes W by the same vector, and
no other generalized momentum changes. Ends push and never
pull: which of them do is a linear complementarity problem, and has one answer, for its matrix
G M^-1 G^T is positive definite (Cottle, Pang & Stone, The Linear Complementarity Problem, 3.1.6).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import nnls

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import trace
from sst_ros.dynamics.traced_dynamics import QUATERNION, Dynamics, Function, compiled
from sst_ros.mechanism.vec3 import ZERO, Rows, Triple, added, dot, scaled, solve_symmetric

Vector = tuple[float, ...]

_ROUNDING = 64 * 2.220446049250313e-16
_NEWTON = 2
"""Steps of Newton's method: what has drifted off is small, and each doubles the digits."""


class RigidEnds:
    """Contact at the ends of the stroke of one scene; legs are counted from 0."""

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics = dynamics

    def after_impact(
        self, y: Vector, leg: int, restitution: float, held: Sequence[int] = ()
    ) -> Vector:
        """Return the state after the actuator of `leg` has hit its end.

        Args:
            y: state before.
            leg: which actuator.
            restitution: - rate after / rate before.
            held: other actuators, which are at rest against an end and stay so.

        """
        rate = -restitution * dot(self._reach(y)[0][leg], _spin(y))
        return self.with_rates(y, {leg: rate} | dict.fromkeys(held, 0.0))

    def with_rates(self, y: Vector, rates: Mapping[int, float]) -> Vector:
        """Return the state after impulses at legs that give them these rates [rad/s]."""
        g, _ = self._reach(y)
        missing = {leg: rate - dot(g[leg], _spin(y)) for leg, rate in rates.items()}
        return (*y[:4], *added(_spin(y), self._response(y, g, missing)[0]), *y[7:])

    def with_angles(self, y: Vector, angles: Mapping[int, float]) -> Vector:
        """Return the state turned, by the smallest means, so that legs are at angles [rad]."""
        for _ in range(_NEWTON):
            now = self._dynamics.joints(*y[:7])
            missing = {leg: angle - now[leg] for leg, angle in angles.items()}
            turn = self._response(y, self._reach(y)[0], missing)[0]
            y = (*_turned(y[:4], turn), *y[4:])
        return y

    def held(self, y: Vector, slope: Vector, legs: Sequence[int]) -> tuple[Vector, Vector]:
        """Hold `legs` still: the derivative of the state, and the torques of the ends [N m].

        Args:
            y: state.
            slope: derivative of the state without the ends.
            legs: the actuators that rest against an end; the torques come in their order.

        """
        g, rest = self._reach(y)
        missing = {leg: -dot(g[leg], _spin(slope)) - rest[leg] for leg in legs}
        change, torques = self._response(y, g, missing)
        turned = added(_spin(slope), change)
        return (*slope[:4], *turned, *slope[7:]), tuple(torques[leg] for leg in legs)

    def holding(self, y: Vector, slope: Vector, inward: Mapping[int, float]) -> list[int]:
        """Return the legs whose ends push, and so hold; the others are left behind.

        Args:
            y: state, in which these actuators are at their ends and do not move.
            slope: derivative of the state without the ends.
            inward: by leg, the sign of the rate that leads away from the end.

        """
        g, rest = self._reach(y)
        free = {leg: dot(g[leg], _spin(slope)) + rest[leg] for leg in inward}
        return self._pushing(y, free, inward)

    def kicked(self, y: Vector, leg: int, inward: Mapping[int, float]) -> list[int]:
        """Return the legs whose ends give an impulse when `leg` is hit while the others hold."""
        rate = dot(self._reach(y)[0][leg], _spin(y))
        return self._pushing(y, dict.fromkeys(inward, 0.0) | {leg: rate}, inward)

    def rounding(self, y: Vector, leg: int) -> float:
        """Rate [rad/s] of an actuator that its rounding cannot turn around."""
        g = self._reach(y)[0][leg]
        terms = [abs(a * b) for a, b in zip(g, _spin(y), strict=True)]
        return _ROUNDING * math.fsum(terms) + 1e-100

    def _pushing(
        self, y: Vector, free: Mapping[int, float], inward: Mapping[int, float]
    ) -> list[int]:
        """Legs where x is not zero: x >= 0, A x + b >= 0, x . (A x + b) = 0.

        x minimises x.A x / 2 + b.x over x >= 0: least squares without negative numbers.
        """
        legs = list(inward)
        sign = np.array([inward[leg] for leg in legs])
        g, m_g = self._reach(y)[0], np.array(self._columns(*y[:4])).reshape(3, 3)
        matrix = sign[:, None] * (np.array(g)[legs] @ m_g[legs].T) * sign
        unit = 1.0 / np.sqrt(np.diag(matrix))
        load = unit * sign * np.array([free[leg] for leg in legs])
        largest = np.abs(load).max()
        if not largest > 0.0:
            return []
        lower = np.linalg.cholesky(unit[:, None] * matrix * unit)
        found = nnls(lower.T, np.linalg.solve(lower, -load / largest))[0]
        return [leg for leg, x in zip(legs, found, strict=True) if x > 0.0]

    def _reach(self, y: Vector) -> tuple[Rows, Triple]:
        """Rows g_k, gamma_dot = g W, and gamma_ddot at W_dot = 0."""
        numbers = iter(self._dynamics.reach(*y[:7]))
        first, second, third, rest = zip(numbers, numbers, numbers, strict=True)
        return (first, second, third), rest

    def _response(self, y: Vector, g: Rows, wanted: Mapping[int, float]) -> tuple[Triple, Triple]:
        """Change of W that makes g_k.change what is wanted, and what must act at the legs for it.

        That is zero at the legs of which nothing is wanted: their rows are those of 1.
        """
        numbers = iter(self._columns(*y[:4]))
        m_g = tuple(zip(numbers, numbers, numbers, strict=True))

        def entry(i: int, j: int) -> float:
            return dot(g[i], m_g[j]) if i in wanted and j in wanted else float(i == j)

        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        acts = solve_symmetric(
            *(entry(i, j) for i, j in pairs), *(wanted.get(k, 0.0) for k in range(3))
        )
        change = [sum(acts[k] * m_g[k][i] for k in wanted) for i in range(3)]
        return (change[0], change[1], change[2]), acts

    @cached_property
    def _columns(self) -> Function:
        """M^-1 g_k of all legs, nine numbers, of the quaternion."""

        def columns(*quaternion: Any) -> tuple[Any, ...]:
            at = kernel.balance(self._dynamics.model, quaternion, ZERO, ZERO)
            return tuple(x for g in at.reach for x in solve_symmetric(*at.inertia, *g))

        return compiled(trace(columns, QUATERNION))


def _spin(y: Vector) -> Triple:
    return y[4], y[5], y[6]


def _turned(q: Vector, turn: Triple) -> Vector:
    """Turn a unit quaternion about axes in {E} by the small angle |turn| [rad]."""
    (x, y, z, w), (a, b, c) = q, scaled(0.5, turn)
    more = (w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a)
    new = (*added((x, y, z), more), w - x * a - y * b - z * c)
    length = math.hypot(*new)
    return tuple(number / length for number in new)
