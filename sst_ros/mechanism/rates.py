# SPDX-License-Identifier: Apache-2.0
"""Rates and accelerations of every joint and link, and the moments that their joints transmit.

One leg equation, Eqs. 9 and 24 to 27, serves both directions; with c_k = (r x t).w = (w x r).t::

    omega     = w gamma_dot - r mu_dot - t beta_dot
    omega_dot = w gamma_ddot - r mu_ddot - t beta_ddot
                - gamma_dot mu_dot (w x r) - beta_dot (omega x t)

Scalar products with N = r x t, r and w x r give gamma, mu and beta of a leg from the star; this
needs no J2 and works at a parallel singularity. From the actuators, omega = J gamma_dot, Eq. 15,
and omega_dot = J gamma_ddot - J2^-1 (M gamma_dot + n), Eq. 40, come first.

All seven links turn about O, so every joint is a revolute about an axis through O: w_k (base to
actuated link), r_k (to the intermediate link), t_k (the curved prismatic joint, to the star).
Without friction it transmits a moment about O across its axis: 9 x 2 components, which with 3
torques are as many as the 7 x 3 moment balances. So they are determinate, and each leg gives them
in closed form: with the rates of change of angular momentum D_1k and D_2k of its links, the moment
m on the star obeys::

    t.m = 0,   r.m = -r.D_2k,   w.m = tau_k - w.(D_1k + D_2k),

three equations with the determinant c_k. Only the moment about O is determinate: the forces in
the bearings depend on where and how many they are. Divide by a bearing distance to size one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import SingularConfiguration, refuse_unless
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Array, Geometry, cross, frozen, rotation_matrix
from sst_ros.mechanism.virtual_work import SINGULAR, Mechanism, Posture, Three
from sst_ros.state import ZERO


@dataclass(frozen=True)
class BodyRates:
    """Velocities and accelerations of all nine joints and seven links. Read-only, rows by leg."""

    omega: Array  #: of the star, in {B} [rad/s], shape (3,)
    omega_dot: Array  #: [rad/s^2]
    gamma_dot: Array  #: joint rates [rad/s], shape (3,)
    mu_dot: Array
    beta_dot: Array
    gamma_ddot: Array  #: joint accelerations [rad/s^2], shape (3,)
    mu_ddot: Array
    beta_ddot: Array
    omega_a: Array  #: of actuated links, in {1k} [rad/s], Eqs. 53 to 57, shape (3, 3)
    omega_a_dot: Array
    omega_ipl: Array  #: of intermediate links, in {2k}, Eqs. 58 to 62 and 75 to 79, (3, 3)
    omega_ipl_dot: Array


def of_actuators(at: Posture, gamma_dot: ArrayLike, gamma_ddot: ArrayLike = ZERO) -> BodyRates:
    """Everything from gamma_dot [rad/s] and gamma_ddot [rad/s^2], each shape (3,)."""
    rate, acceleration = np.array(gamma_dot, dtype=float), np.array(gamma_ddot, dtype=float)
    omega = at.j @ rate
    omega_dot = at.j @ acceleration + virtual_work.bias(at, rate).omega_dot
    return _motion(at.r, at.t, at.w, omega, omega_dot, rate, acceleration)


def of_star(
    geometry: Geometry,
    rotation: ArrayLike,
    omega: ArrayLike,
    omega_dot: ArrayLike = ZERO,
    gamma: ArrayLike | None = None,
) -> BodyRates:
    """Everything from omega [rad/s] and omega_dot [rad/s^2] of the star in {B}, each shape (3,).

    The rotation R of {E} in {B} has the shape (3, 3); the actuator angles gamma [rad] choose the
    branch of each leg, by default mu_k in (0, pi). SingularConfiguration is raised where some
    c_k = 0 (serial).
    """
    matrix = np.asarray(rotation, dtype=float)
    if gamma is None:
        gamma = kinematics.inverse(geometry, matrix)[0]
    r = kinematics.carriage_directions(geometry, gamma)
    t, w = geometry.e @ matrix.T, geometry.w
    c = np.sum(cross(r, t) * w, axis=1)
    if np.min(np.abs(c)) < SINGULAR:
        raise SingularConfiguration("serial singularity, c_k = 0", float(np.min(np.abs(c))))
    return _motion(r, t, w, np.array(omega, dtype=float), np.array(omega_dot, dtype=float))


def body_rates(
    geometry: Geometry, quaternion: Array, gamma_dot: Array, mu_dot: Array, beta_dot: Array
) -> Array:
    """Compute W in {E} [rad/s], shape (..., 3), from the rates of the joints [rad/s], (..., 3).

    It follows from each leg, W = w gamma_dot - r mu_dot - t beta_dot (Eq. 10), without a matrix
    that could be singular; the mean of the three is taken. Where the orientation is nan, it is.
    """
    known = np.isfinite(quaternion).all(axis=-1, keepdims=True)
    rotation = rotation_matrix(np.where(known, quaternion, (0.0, 0.0, 0.0, 1.0)))
    t, w = geometry.e, geometry.w @ rotation  # rows in {E}
    r = np.cross(t, w)
    r /= np.linalg.norm(r, axis=-1)[..., None]
    of_legs = w * gamma_dot[..., None] - r * mu_dot[..., None] - t * beta_dot[..., None]
    return np.asarray(np.where(known, of_legs.mean(axis=-2), np.nan))


def _motion(
    r: Array, t: Array, w: Array, omega: Array, omega_dot: Array, *actuators: Array
) -> BodyRates:
    """All joints and links; gamma_dot and gamma_ddot are those of `actuators` where given."""
    normal, wr, turning = cross(r, t), cross(w, r), cross(omega, t)
    c = np.sum(normal * w, axis=1)
    gamma_dot = (normal @ omega) / c  # Eq. 10
    mu_dot = -(r @ omega)  # Eq. 18
    beta_dot = -(wr @ omega) / c  # Eq. 21
    push = gamma_dot * mu_dot
    gamma_ddot = (
        normal @ omega_dot
        + push * np.sum(normal * wr, axis=1)
        + beta_dot * np.sum(normal * turning, axis=1)
    ) / c  # Eq. 29
    mu_ddot = -(r @ omega_dot) - beta_dot * np.sum(r * turning, axis=1)  # Eq. 42
    beta_ddot = -(wr @ omega_dot + push + beta_dot * np.sum(wr * turning, axis=1)) / c  # Eq. 46
    gamma_dot, gamma_ddot = actuators or (gamma_dot, gamma_ddot)
    joints = gamma_dot, mu_dot, beta_dot, gamma_ddot, mu_ddot, beta_ddot
    x, zero = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    omega_a, omega_a_dot = (np.stack([zero, zero, x], axis=1) for x in (gamma_dot, gamma_ddot))
    # {2k} = [r, t x r, t]; w has no component along r.
    turn = np.stack([zero, np.sum(w * cross(t, r), axis=1), np.sum(w * t, axis=1)], axis=1)
    omega_ipl = gamma_dot[:, None] * turn - mu_dot[:, None] * x
    # (d/dt)(-r mu_dot) in {B} is -r mu_ddot - gamma_dot mu_dot (w x r); w is constant.
    across = cross(turn, np.broadcast_to(x, turn.shape))
    omega_ipl_dot = (
        gamma_ddot[:, None] * turn - mu_ddot[:, None] * x - (gamma_dot * mu_dot)[:, None] * across
    )
    links = omega_a, omega_a_dot, omega_ipl, omega_ipl_dot
    return BodyRates(*frozen(omega, omega_dot, *joints, *links))


@dataclass(frozen=True)
class Reactions:
    """Constraint moments about O [N m], shape (3, 3), rows by leg. Read-only.

    A moment is what the link nearer the base exerts on the next one; the next one answers with
    the opposite. In the frame of its own joint the component along the axis is 0.
    """

    #: base on actuated link k, across w_k, in {B}; the torque tau_k w_k not included
    actuated: Array
    revolute: Array  #: actuated on intermediate link, across r_k, in {B}
    prismatic: Array  #: intermediate link on the star, across t_k, in {B}
    actuated_local: Array  #: in {1k} = [r, w x r, w]; z is 0
    revolute_local: Array  #: in {2k} = [r, t x r, t]; x is 0
    prismatic_local: Array  #: in {2k}; z is 0
    torque: Array  #: actuator torques that belong to this motion [N m], shape (3,)


def of_motion(
    mechanism: Mechanism, at: Posture, gamma_dot: Three, gamma_ddot: Three, moment: Three = ZERO
) -> Reactions:
    """Constraint moments, and torques, that a motion asks for: gamma_dot [rad/s], gamma_ddot.

    The moment is n_ext [N m] in {B}, beside the weights of all bodies. For the motion that torques
    cause see `virtual_work.direct_dynamics`. InputError refuses scenes with friction, springs or
    elastic stops.
    """
    allowed = f"a scene with {', '.join(mechanism.others)} has moments that are not known here"
    refuse_unless("reactions", ("scene", mechanism.others, not mechanism.others, allowed))
    frames = virtual_work.link_frames(at)
    of_star, *of_links = mechanism.weights
    weight = np.asarray(moment) + cross(at.rotation @ of_star, mechanism.gravity)
    torque = virtual_work.inverse_dynamics(mechanism, at, gamma_dot, gamma_ddot, weight)
    # Moments of the weights of links about O in their own frames, which work by their Jacobians.
    local_weights = [
        cross(centre, mechanism.gravity @ frame)
        for centre, frame in zip(of_links, frames, strict=True)
    ]
    for jacobian, acting in zip(virtual_work.link_jacobians(at), local_weights, strict=True):
        torque = torque - np.einsum("kij,ki->j", jacobian, acting)
    motion = of_actuators(at, gamma_dot, gamma_ddot)
    inertias = mechanism.actuated, mechanism.intermediate
    rates = (motion.omega_a, motion.omega_a_dot), (motion.omega_ipl, motion.omega_ipl_dot)
    # I omega_dot + omega x I omega of three links in their own frames, less weights; then in {B}.
    changes = (
        np.einsum("kij,kj->ki", i, omega_dot)
        + cross(omega, np.einsum("kij,kj->ki", i, omega))
        - acting
        for i, (omega, omega_dot), acting in zip(inertias, rates, local_weights, strict=True)
    )
    d1, d2 = (np.einsum("kij,kj->ki", f, d) for f, d in zip(frames, changes, strict=True))
    # With t.m = 0 and r, N = r x t across t: m = x r + y N, and w.r = 0, w.N = c.
    x = -np.sum(at.r * d2, axis=1)
    y = (torque - np.sum(at.w * (d1 + d2), axis=1)) / at.c
    prismatic = x[:, None] * at.r + y[:, None] * cross(at.r, at.t)
    revolute = prismatic + d2
    actuated = revolute + d1 - torque[:, None] * at.w
    moments, own_frames = [actuated, revolute, prismatic], (*frames, frames[1])
    local = [np.einsum("kij,ki->kj", f, m) for f, m in zip(own_frames, moments, strict=True)]
    for array, axis in zip(local, (2, 0, 2), strict=True):
        array[:, axis] = 0.0  # by the equations above; what rounding left goes
    return Reactions(*frozen(*moments, *local, torque))
