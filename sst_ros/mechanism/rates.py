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
from sst_ros.mechanism.geometry import (
    CYCLIC,
    Array,
    Geometry,
    cross,
    frozen,
    rotation_matrix,
)
from sst_ros.mechanism.virtual_work import SINGULAR_MATRIX, Posture
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
    #: of intermediate links, in {2k}, Eqs. 58 to 62 and 75 to 79, shape (3, 3)
    omega_ipl: Array
    omega_ipl_dot: Array


def of_actuators(
    at: Posture, gamma_dot: ArrayLike, gamma_ddot: ArrayLike = ZERO
) -> BodyRates:
    """Everything from gamma_dot [rad/s] and gamma_ddot [rad/s^2], each shape (3,)."""
    rate = np.array(gamma_dot, dtype=float)
    acceleration = np.array(gamma_ddot, dtype=float)
    omega = at.j @ rate
    omega_dot = at.j @ acceleration + virtual_work.bias(at, rate).omega_dot
    return _motion(at.r, at.t, at.w, omega, omega_dot, (rate, acceleration))


def of_star(
    geometry: Geometry,
    rotation: ArrayLike,
    omega: ArrayLike,
    omega_dot: ArrayLike = ZERO,
    gamma: ArrayLike | None = None,
) -> BodyRates:
    """Everything from omega [rad/s] and omega_dot [rad/s^2] of the star in {B}.

    Both have the shape (3,). The rotation R of {E} in {B} has the shape (3, 3); the
    actuator angles gamma [rad] choose the branch of each leg, by default mu_k in (0,
    pi). SingularConfiguration is raised where some c_k = 0 (serial).
    """
    matrix = np.asarray(rotation, dtype=float)
    if gamma is None:
        gamma, _, _ = kinematics.inverse(geometry, matrix)
    r = kinematics.carriage_directions(geometry, gamma)
    t = geometry.e @ matrix.T
    w = geometry.w
    c = np.sum(cross(r, t) * w, axis=1)
    least = float(np.min(np.abs(c)))
    if least < SINGULAR_MATRIX:
        raise SingularConfiguration("serial singularity, c_k = 0", least)
    rate = np.array(omega, dtype=float)
    acceleration = np.array(omega_dot, dtype=float)
    return _motion(r, t, w, rate, acceleration)


def body_rates(
    geometry: Geometry,
    quaternion: Array,
    gamma_dot: Array,
    mu_dot: Array,
    beta_dot: Array,
) -> Array:
    """Compute W in {E} from the rates of the joints, in rad/s and of shape (..., 3).

    It follows from each leg, W = w gamma_dot - r mu_dot - t beta_dot (Eq. 10), without
    a matrix that could be singular; the mean of the three is taken. Where the
    orientation is nan, it is.
    """
    is_finite = np.isfinite(quaternion).all(axis=-1, keepdims=True)
    rotation = rotation_matrix(np.where(is_finite, quaternion, (0.0, 0.0, 0.0, 1.0)))
    t = geometry.e  # rows in {E}, as those of w and r
    w = geometry.w @ rotation
    r = np.cross(t, w)
    r /= np.linalg.norm(r, axis=-1)[..., None]
    of_gamma = w * gamma_dot[..., None]
    of_mu = r * mu_dot[..., None]
    of_beta = t * beta_dot[..., None]
    of_legs = of_gamma - of_mu - of_beta
    return np.asarray(np.where(is_finite, of_legs.mean(axis=-2), np.nan))


def _motion(
    r: Array,
    t: Array,
    w: Array,
    omega: Array,
    omega_dot: Array,
    actuators: tuple[Array, Array] | None = None,
) -> BodyRates:
    """Return the motion of all joints and links.

    Where gamma_dot and gamma_ddot are known, they are given as `actuators`.
    """
    normal = cross(r, t)
    wr = cross(w, r)
    t_dot = cross(omega, t)
    c = np.sum(normal * w, axis=1)
    gamma_dot = (normal @ omega) / c  # Eq. 10
    mu_dot = -(r @ omega)  # Eq. 18
    beta_dot = -(wr @ omega) / c  # Eq. 21
    product = gamma_dot * mu_dot
    of_product = product * np.sum(normal * wr, axis=1)
    of_t_dot = beta_dot * np.sum(normal * t_dot, axis=1)
    gamma_ddot = (normal @ omega_dot + of_product + of_t_dot) / c  # Eq. 29
    mu_ddot = -(r @ omega_dot) - beta_dot * np.sum(r * t_dot, axis=1)  # Eq. 42
    across_t_dot = beta_dot * np.sum(wr * t_dot, axis=1)
    beta_ddot = -(wr @ omega_dot + product + across_t_dot) / c  # Eq. 46
    if actuators is not None:
        gamma_dot, gamma_ddot = actuators
    zero = np.zeros(3)
    x = np.array([1.0, 0.0, 0.0])
    # w in {2k} = [r, t x r, t]: it has no component along r.
    w_across = np.sum(w * cross(t, r), axis=1)
    w_along = np.sum(w * t, axis=1)
    turn = np.stack([zero, w_across, w_along], axis=1)
    # (d/dt)(-r mu_dot) in {B} is -r mu_ddot - gamma_dot mu_dot (w x r); w is constant.
    across = cross(turn, np.broadcast_to(x, turn.shape))
    of_gamma = gamma_ddot[:, None] * turn
    of_mu = mu_ddot[:, None] * x
    of_both = (gamma_dot * mu_dot)[:, None] * across
    motion = BodyRates(
        omega=omega,
        omega_dot=omega_dot,
        gamma_dot=gamma_dot,
        mu_dot=mu_dot,
        beta_dot=beta_dot,
        gamma_ddot=gamma_ddot,
        mu_ddot=mu_ddot,
        beta_ddot=beta_ddot,
        omega_a=np.stack([zero, zero, gamma_dot], axis=1),
        omega_a_dot=np.stack([zero, zero, gamma_ddot], axis=1),
        omega_ipl=gamma_dot[:, None] * turn - mu_dot[:, None] * x,
        omega_ipl_dot=of_gamma - of_mu - of_both,
    )
    frozen(*vars(motion).values())
    return motion


class OrientationSensitivity(NamedTuple):
    """Derivatives of the orientation, as rotation vectors in {E} [rad].

    The first axis behind the poses has the components of the rotation vector.
    """

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
        gamma, _, _ = kinematics.inverse(geometry, matrix)
    angles = np.asarray(gamma, dtype=float)
    w = geometry.w
    r = kinematics.carriage_directions(geometry, angles)
    t = kinematics.star_axes(geometry, matrix)
    shape = angles.shape[:-1]
    by_gamma = np.zeros((*shape, 3, 3))  # change of F by leg, then by parameter
    by_v = np.zeros((*shape, 3, 3, 3))
    by_alpha = np.zeros((*shape, 3, 3))
    alpha_12, alpha_23, _ = geometry.alpha
    turns = np.cumsum([0.0, alpha_12, alpha_23])
    for k, following, _ in CYCLIC:
        r_k = r[..., k, :]
        t_k = t[..., k, :]
        sine = np.sin(angles[..., k, None])
        cosine = np.cos(angles[..., k, None])
        by_gamma[..., k, k] = _dot(np.cross(w[k], r_k), t_k)
        for leg in (k, following):
            for axis in range(3):
                moved_v_k, moved_across = _move_arc(geometry, k, following, leg, axis)
                moved_r = cosine * moved_v_k + sine * moved_across
                by_v[..., k, leg, axis] = _dot(moved_r, t_k)
        turn = turns[k]
        e_slope = np.array([-np.cos(turn), -np.sin(turn), 0.0])
        by_turn = _dot(r_k, matrix @ e_slope)
        by_alpha[..., k, :k] = by_turn[..., None]
    j2 = cross(t, r)
    least = float(np.min(np.abs(np.linalg.det(j2))))
    if least < SINGULAR_MATRIX:
        raise SingularConfiguration("parallel singularity, det J2 = 0", least)
    by_residual = -np.swapaxes(matrix, -1, -2) @ np.linalg.inv(j2)
    of_v = by_residual @ by_v.reshape(*shape, 3, 9)
    return OrientationSensitivity(
        gamma=by_residual @ by_gamma,
        v=of_v.reshape(*shape, 3, 3, 3),
        alpha=by_residual @ by_alpha,
    )


def _move_arc(
    geometry: Geometry, k: int, following: int, leg: int, axis: int
) -> tuple[Array, Array]:
    """Differentiate v_k and w_k x v_k by a component of v of a leg, k or the following.

    v stays a unit vector: its change is across itself.
    """
    v = geometry.v
    w = geometry.w
    moved_v = np.eye(3)[axis] - v[leg] * v[leg][axis]
    if leg == k:
        moved_v_k = moved_v
        moved_normal = cross(moved_v, v[following])
    else:
        moved_v_k = np.zeros(3)
        moved_normal = cross(v[k], moved_v)
    across_w = moved_normal - w[k] * (w[k] @ moved_normal)
    moved_w = across_w / np.sin(geometry.arc[k])
    return moved_v_k, cross(moved_w, v[k]) + cross(w[k], moved_v_k)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
