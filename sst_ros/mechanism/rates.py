# SPDX-License-Identifier: Apache-2.0
"""Rates and accelerations of every joint and link.

One leg equation, Eqs. 9 and 24 to 27, serves both directions; with c_k = (r x t).w = (w
x r).t::

    omega     = w gamma_dot - r mu_dot - t beta_dot
    omega_dot = w gamma_ddot - r mu_ddot - t beta_ddot
                - gamma_dot mu_dot (w x r) - beta_dot (omega x t)

Scalar products with N = r x t, r and w x r give gamma, mu and beta of a leg from the
star; this needs no J2 and works at a parallel singularity. From the actuators, omega =
J gamma_dot, Eq. 15, and omega_dot = J gamma_ddot - J2^-1 (M gamma_dot + n), Eq. 40,
come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Array, Geometry, cross, frozen, rotation_matrix
from sst_ros.mechanism.virtual_work import SINGULAR, Posture
from sst_ros.state import ZERO


@dataclass(frozen=True)
class BodyRates:
    """Velocities and accelerations of all nine joints and seven links.

    Read-only, rows by leg.
    """

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
    #: of intermediate links, in {2k}, Eqs. 58 to 62 and 75 to 79, (3, 3)
    omega_ipl: Array
    omega_ipl_dot: Array


def of_actuators(
    at: Posture, gamma_dot: ArrayLike, gamma_ddot: ArrayLike = ZERO
) -> BodyRates:
    """Everything from gamma_dot [rad/s] and gamma_ddot [rad/s^2], each shape (3,)."""
    rate, acceleration = (
        np.array(gamma_dot, dtype=float),
        np.array(gamma_ddot, dtype=float),
    )
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

    The rotation R of {E} in {B} has the shape (3, 3); the actuator angles gamma [rad]
    choose the branch of each leg, by default mu_k in (0, pi). SingularConfiguration is
    raised where some c_k = 0 (serial).
    """
    matrix = np.asarray(rotation, dtype=float)
    if gamma is None:
        gamma = kinematics.inverse(geometry, matrix)[0]
    r = kinematics.carriage_directions(geometry, gamma)
    t, w = geometry.e @ matrix.T, geometry.w
    c = np.sum(cross(r, t) * w, axis=1)
    if np.min(np.abs(c)) < SINGULAR:
        raise SingularConfiguration(
            "serial singularity, c_k = 0", float(np.min(np.abs(c)))
        )
    return _motion(
        r, t, w, np.array(omega, dtype=float), np.array(omega_dot, dtype=float)
    )


def body_rates(
    geometry: Geometry,
    quaternion: Array,
    gamma_dot: Array,
    mu_dot: Array,
    beta_dot: Array,
) -> Array:
    """Compute W in {E} [rad/s], shape (..., 3), from the rates of the joints [rad/s], (..., 3).

    It follows from each leg, W = w gamma_dot - r mu_dot - t beta_dot (Eq. 10), without
    a matrix that could be singular; the mean of the three is taken. Where the
    orientation is nan, it is.
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
    """All joints and links.

    gamma_dot and gamma_ddot are those of `actuators` where given.
    """
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
    # Eq. 46
    beta_ddot = -(wr @ omega_dot + push + beta_dot * np.sum(wr * turning, axis=1)) / c
    gamma_dot, gamma_ddot = actuators or (gamma_dot, gamma_ddot)
    joints = gamma_dot, mu_dot, beta_dot, gamma_ddot, mu_ddot, beta_ddot
    x, zero = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    omega_a, omega_a_dot = (
        np.stack([zero, zero, x], axis=1) for x in (gamma_dot, gamma_ddot)
    )
    # {2k} = [r, t x r, t]; w has no component along r.
    turn = np.stack(
        [zero, np.sum(w * cross(t, r), axis=1), np.sum(w * t, axis=1)], axis=1
    )
    omega_ipl = gamma_dot[:, None] * turn - mu_dot[:, None] * x
    # (d/dt)(-r mu_dot) in {B} is -r mu_ddot - gamma_dot mu_dot (w x r); w is constant.
    across = cross(turn, np.broadcast_to(x, turn.shape))
    omega_ipl_dot = (
        gamma_ddot[:, None] * turn
        - mu_ddot[:, None] * x
        - (gamma_dot * mu_dot)[:, None] * across
    )
    links = omega_a, omega_a_dot, omega_ipl, omega_ipl_dot
    return BodyRates(*frozen(omega, omega_dot, *joints, *links))


class OrientationSensitivity(NamedTuple):
    """Derivatives of the orientation, as rotation vectors in {E} [rad]: components first."""

    gamma: Array  #: by the actuator angles, shape (..., 3, 3)
    v: Array  #: by the unit directions v_k, leg and axis, shape (..., 3, 3, 3)
    #: by the angles of the star [rad], the last of which is 2 pi less the others
    alpha: Array


def orientation_sensitivity(
    geometry: Geometry, rotation: ArrayLike, gamma: ArrayLike | None = None
) -> OrientationSensitivity:
    """Differentiate the orientation by actuator angles and geometry, exactly.

    The closed loops F_k = r_k . R e_k = 0 give, for a turn d of the star in {B},

        (t_k x r_k) . d = -(dr_k . t_k + r_k . R de_k),

    three equations with the matrix J2. The change of r_k is that of gamma_k, of v_k,
    and of w_k, which v_k and v_k+1 span. With these derivatives, tolerances of encoders
    and parts give the error of the orientation.

    Args:
        geometry: of the manipulator.
        rotation: orientations R, shape (..., 3, 3).
        gamma: actuator angles [rad], shape (..., 3); by default mu_k in (0, pi).

    Raises:
        SingularConfiguration: some orientation is a parallel singularity, det J2 = 0.

    """
    matrix = np.asarray(rotation, dtype=float)
    if gamma is None:
        gamma = kinematics.inverse(geometry, matrix)[0]
    angles = np.asarray(gamma, dtype=float)
    v, w = geometry.v, geometry.w
    r = kinematics.carriage_directions(geometry, angles)
    t = geometry.e @ np.swapaxes(matrix, -1, -2)
    shape = angles.shape[:-1]
    by_gamma = np.zeros((*shape, 3, 3))  # change of F by leg, then by parameter
    by_v = np.zeros((*shape, 3, 3, 3))
    by_alpha = np.zeros((*shape, 3, 3))
    axes = np.eye(3)
    turns = np.cumsum([0.0, *geometry.alpha[:2]])
    for k in range(3):
        following = (k + 1) % 3
        sine, cosine = np.sin(angles[..., k, None]), np.cos(angles[..., k, None])
        by_gamma[..., k, k] = _dot(np.cross(w[k], r[..., k, :]), t[..., k, :])
        for axis in range(3):
            for leg in (k, following):
                moved = axes[axis] - v[leg] * v[leg][axis]  # of a unit vector
                if leg == k:
                    normal, along = cross(moved, v[following]), moved
                else:
                    normal, along = cross(v[k], moved), np.zeros(3)
                normal = (normal - w[k] * (w[k] @ normal)) / np.sin(geometry.arc[k])
                across = cross(normal, v[k]) + cross(w[k], along)
                change = cosine * along + sine * across
                by_v[..., k, leg, axis] = _dot(change, t[..., k, :])
        turned = np.array([-np.cos(turns[k]), -np.sin(turns[k]), 0.0])
        by_turn = _dot(r[..., k, :], matrix @ turned)
        by_alpha[..., k, :k] = by_turn[..., None]
    j2 = cross(t, r)
    determinant = np.linalg.det(j2)
    if np.min(np.abs(determinant)) < SINGULAR:
        least = float(np.min(np.abs(determinant)))
        raise SingularConfiguration("parallel singularity, det J2 = 0", least)
    solved = -np.swapaxes(matrix, -1, -2) @ np.linalg.inv(j2)
    of_v = solved @ by_v.reshape(*shape, 3, 9)
    return OrientationSensitivity(
        solved @ by_gamma, of_v.reshape(*shape, 3, 3, 3), solved @ by_alpha
    )


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
