# SPDX-License-Identifier: Apache-2.0
"""Rates and accelerations of every joint and link.

One leg equation, Eqs. 9 and 24 to 27, serves both directions; with c_k = (r x t).w = (w x r).t::

    omega     = w gamma_dot - r mu_dot - t beta_dot
    omega_dot = w gamma_ddot - r mu_ddot - t beta_ddot
                - gamma_dot mu_dot (w x r) - beta_dot (omega x t)

Scalar products with N = r x t, r and w x r give gamma, mu and beta of a leg from the star; this
needs no J2 and works at a parallel singularity. From the actuators, omega = J gamma_dot, Eq. 15,
and omega_dot = J gamma_ddot - J2^-1 (M gamma_dot + n), Eq. 40, come first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Array, Geometry, cross, frozen, rotation_matrix
from sst_ros.mechanism.virtual_work import SINGULAR, Posture
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
