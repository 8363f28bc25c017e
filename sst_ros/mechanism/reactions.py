# SPDX-License-Identifier: Apache-2.0
"""Constraint moments at all nine joints: what the virtual work eliminates.

All seven links turn about O, so every joint is a revolute about an axis through O: w_k (base to
actuated link), r_k (to the intermediate link), t_k (the curved prismatic joint, to the star). A
joint without friction transmits a moment about O with two components, both across its axis. The
9 x 2 components and 3 torques (or accelerations) are as many as the 7 x 3 moment balances, so the
moments about O are determinate, and each leg gives them in closed form: with the rates of change
of angular momentum D_1k and D_2k of its links, the moment m on the star obeys

    t.m = 0,   r.m = -r.D_2k,   w.m = tau_k - w.(D_1k + D_2k),

three equations with the determinant c_k. Only the moment about O is determinate: the forces in
the bearings depend on where and how many they are. Divide by a bearing distance to size one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.mechanism import rates, virtual_work
from sst_ros.mechanism.direct_kinematics import cross
from sst_ros.mechanism.geometry import Array, frozen
from sst_ros.mechanism.virtual_work import Mechanism, Posture


@dataclass(frozen=True)
class Reactions:
    """Constraint moments about O [N m], shape (3, 3), rows by leg. Read-only.

    A moment is what the link nearer the base exerts on the next one; the next one answers with
    the opposite. In the frame of its own joint the component along the axis is 0.

    Attributes:
        actuated: base on actuated link k, across w_k, in {B}; the torque tau_k w_k not included.
        revolute: actuated on intermediate link, across r_k, in {B}.
        prismatic: intermediate link on the star, across t_k, in {B}.
        actuated_local: in {1k} = [r, w x r, w]; z is 0.
        revolute_local: in {2k} = [r, t x r, t]; x is 0.
        prismatic_local: in {2k}; z is 0.
        torque: actuator torques that belong to this motion [N m], shape (3,).

    """

    actuated: Array
    revolute: Array
    prismatic: Array
    actuated_local: Array
    revolute_local: Array
    prismatic_local: Array
    torque: Array


def of_torque(
    mechanism: Mechanism,
    at: Posture,
    gamma_dot: ArrayLike,
    torque: ArrayLike,
    moment: ArrayLike = (0.0, 0.0, 0.0),
) -> Reactions:
    """Constraint moments of the motion that torques [N m] and n_ext [N m] in {B} cause."""
    gamma_ddot = virtual_work.direct_dynamics(mechanism, at, gamma_dot, torque, moment)
    return _reactions(mechanism, at, gamma_dot, gamma_ddot, np.array(torque, dtype=float))


def of_motion(
    mechanism: Mechanism,
    at: Posture,
    gamma_dot: ArrayLike,
    gamma_ddot: ArrayLike,
    moment: ArrayLike = (0.0, 0.0, 0.0),
) -> Reactions:
    """Constraint moments, and torques, that a motion gamma_dot, gamma_ddot asks for."""
    torque = virtual_work.inverse_dynamics(mechanism, at, gamma_dot, gamma_ddot, moment)
    return _reactions(mechanism, at, gamma_dot, gamma_ddot, torque)


def _reactions(
    mechanism: Mechanism, at: Posture, gamma_dot: ArrayLike, gamma_ddot: ArrayLike, torque: Array
) -> Reactions:
    motion = rates.of_actuators(at, gamma_dot, gamma_ddot)
    first, second = virtual_work.link_frames(at)
    d1 = _seen(first, _momentum_rate(mechanism.actuated, motion.omega_a, motion.omega_a_dot))
    d2 = _seen(
        second, _momentum_rate(mechanism.intermediate, motion.omega_ipl, motion.omega_ipl_dot)
    )
    # With t.m = 0 and r, N = r x t across t: m = x r + y N, and w.r = 0, w.N = c.
    x = -np.sum(at.r * d2, axis=1)
    y = (torque - np.sum(at.w * (d1 + d2), axis=1)) / at.c
    prismatic = x[:, None] * at.r + y[:, None] * cross(at.r, at.t)
    revolute = prismatic + d2
    actuated = revolute + d1 - torque[:, None] * at.w
    moments = [actuated, revolute, prismatic]
    frames, axes = (first, second, second), (2, 0, 2)
    local = [np.einsum("kij,ki->kj", f, m) for f, m in zip(frames, moments, strict=True)]
    for array, axis in zip(local, axes, strict=True):
        array[:, axis] = 0.0  # by the equations above; what rounding left goes
    return Reactions(*frozen(*moments, *local, np.array(torque)))


def _momentum_rate(inertia: Array, omega: Array, omega_dot: Array) -> Array:
    """I omega_dot + omega x I omega of three links in their own frames [N m]."""
    spin = np.einsum("kij,kj->ki", inertia, omega)
    return np.asarray(np.einsum("kij,kj->ki", inertia, omega_dot) + cross(omega, spin))


def _seen(frames: Array, vectors: Array) -> Array:
    """Vectors of three frames as {B} sees them."""
    return np.asarray(np.einsum("kij,kj->ki", frames, vectors))
