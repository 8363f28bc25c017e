# SPDX-License-Identifier: Apache-2.0
"""The paper's method, equation by equation: the readable form of the dynamics.

Equation numbers are those of Akbarzadeh & Enferadi, J. Intell. Robot. Syst. 63 (2011)
25-49, with the signs that its printed text lost. Rows of (3, 3) arrays named after a
leg's vector (r, t, w) belong to legs; matrices of Jacobians act on columns. Everything
is in {B} unless stated otherwise. The simulation runs `kernel`, which the tests hold
against this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Array, Geometry, columns, cross
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO

VectorLike: TypeAlias = ArrayLike  # three numbers, one a leg or an axis
# smallest abs(det J2) and abs(c_k) for which the velocity analysis is done
SINGULAR_MATRIX = 1e-12


@dataclass(frozen=True)
class Mechanism:
    """Geometry and inertias [kg m^2]; star in {E}, links (3, 3, 3) in {1k} and {2k}."""

    geometry: Geometry
    star: Array
    actuated: Array
    intermediate: Array

    @classmethod
    def of(cls, scene: Scene) -> Mechanism:
        """Collect what the equations need; bodies include payload and rotors."""
        star = scene.star.inertia.matrix
        if scene.payload is not None:
            star = star + scene.payload.about_o
        actuated = np.stack([link.tensor for link in scene.actuated_links])
        motor = scene.actuators
        if motor is not None:
            actuated[:, 2, 2] += motor.gear_ratio**2 * motor.rotor_inertia
        intermediate = np.stack([link.tensor for link in scene.intermediate_links])
        return cls(Geometry.of(scene), star, actuated, intermediate)


@dataclass(frozen=True)
class Posture:
    """Everything that follows from gamma and the assembly R, Eqs. 1 to 23."""

    gamma: Array  #: actuator angles [rad], shape (3,)
    rotation: Array  #: R of {E} in {B}, shape (3, 3)
    r: Array  #: unit vectors by leg, shape (3, 3)
    t: Array
    w: Array
    c: Array  #: c_k = (r_k x t_k) . w_k, diagonal of J1, Eq. 14, shape (3,)
    j2: Array  #: Eq. 13, shape (3, 3)
    j: Array  #: J = -J2^-1 J1, omega = J gamma_dot, Eq. 15
    a: Array  #: mu_dot = a gamma_dot, Eq. 20, rows by leg
    b: Array  #: beta_dot = b gamma_dot, Eq. 23, rows by leg
    u: Array  #: beta_ddot = u gamma_ddot + u_k of Eq. 49; Eq. 48, rows by leg


@dataclass(frozen=True)
class Bias:
    """Velocity products, Eqs. 26 to 49.

    Accelerations are these plus Jacobians times gamma_ddot.
    """

    omega: Array  #: angular velocity of the star [rad/s], Eq. 15
    omega_dot: Array  #: J2^-1 (M gamma_dot + n) with its sign, Eq. 40 [rad/s^2]
    mu_ddot: Array  #: f_k, Eq. 45 [rad/s^2]
    beta_ddot: Array  #: u_k, Eq. 49 [rad/s^2]


def posture(
    geometry: Geometry, gamma: ArrayLike, rotation: Array | None = None
) -> Posture:
    """Velocity analysis at gamma [rad], shape (3,), Eqs. 1 to 23.

    It is that of the assembly with the rotation R, shape (3, 3), or of the admissible
    one.

    Raises:
        AssemblyError: rotation is None and there is no unique admissible assembly.
        SingularConfiguration: det J2 = 0 (parallel) or some c_k = 0 (serial).

    """
    angles = np.asarray(gamma, dtype=float)
    if rotation is None:
        rotation = kinematics.admissible(geometry, angles).rotation
    r = kinematics.carriage_directions(geometry, angles)
    t = geometry.e @ rotation.T
    w = geometry.w
    normal = cross(r, t)
    c = np.sum(normal * w, axis=1)
    j2 = -normal
    determinant = float(np.linalg.det(j2))
    if abs(determinant) < SINGULAR_MATRIX:
        raise SingularConfiguration("parallel singularity, det J2 = 0", determinant)
    least = float(np.min(np.abs(c)))
    if least < SINGULAR_MATRIX:
        raise SingularConfiguration("serial singularity, c_k = 0", least)
    j = np.asarray(-np.linalg.solve(j2, np.diag(c)), dtype=float)
    a = -r @ j
    wr = cross(w, r)
    b = -(wr @ j) / np.sum(wr * t, axis=1)[:, None]
    u = np.diag(np.sum(t * w, axis=1)) - t @ j
    return Posture(
        gamma=angles,
        rotation=rotation,
        r=r,
        t=t,
        w=w,
        c=c,
        j2=j2,
        j=j,
        a=a,
        b=b,
        u=u,
    )


def bias(posture: Posture, gamma_dot: ArrayLike) -> Bias:
    """Acceleration analysis at gamma_ddot = 0, Eqs. 24 to 49."""
    rate = np.asarray(gamma_dot, dtype=float)
    omega = posture.j @ rate
    mu_dot = posture.a @ rate
    beta_dot = posture.b @ rate
    tw = np.sum(posture.t * posture.w, axis=1)
    m = mu_dot * tw  # Eq. 38
    n = -beta_dot * (posture.r @ omega)  # Eq. 39
    solved = np.linalg.solve(posture.j2, m * rate + n)
    tr = cross(posture.t, posture.r)
    f = -beta_dot * (tr @ omega) + posture.r @ solved  # Eq. 45
    wr = cross(posture.w, posture.r)
    u = posture.t @ solved - np.sum(posture.t * wr, axis=1) * rate * mu_dot  # Eq. 49
    return Bias(omega, -solved, f, u)


def link_frames(posture: Posture) -> tuple[Array, Array]:
    """Rotations of {1k} and {2k} in {B}, Eqs. 50 to 52, each shape (3, 3, 3)."""
    r = posture.r
    t = posture.t
    w = posture.w
    return columns(r, cross(w, r), w), columns(r, cross(t, r), t)


def link_jacobians(posture: Posture) -> tuple[Array, Array]:
    """Direct link Jacobians J_a in {1k} and J_ipl in {2k}, Eqs. 57 and 61.

    Shape (3, 3, 3) each, legs first.
    """
    first, second = link_frames(posture)
    d = np.eye(3)
    ja = np.empty((3, 3, 3))
    jipl = np.empty((3, 3, 3))
    for k in range(3):
        of_gamma = np.outer(posture.w[k], d[k])
        of_mu = np.outer(posture.r[k], posture.a[k])
        ja[k] = first[k].T @ of_gamma
        jipl[k] = second[k].T @ (of_gamma - of_mu)
    return ja, jipl


def equation_of_motion(
    mechanism: Mechanism, at: Posture, gamma_dot: VectorLike, moment: VectorLike = ZERO
) -> tuple[Array, Array]:
    """T1 and T2 of the equation of motion T1 gamma_ddot + T2 + tau = 0, Eqs. 63 to 92.

    T1 has the shape (3, 3) [kg m^2], T2 (3,) [N m]. M = -T1 is the mass matrix,
    positive definite; -T2 without a moment has the velocity products. gamma_dot is in
    rad/s, the moment n_ext on the star in {B} in N m. Inertia tensors may be full.
    """
    rate = np.asarray(gamma_dot, dtype=float)
    products = bias(at, rate)
    inertia = at.rotation @ mechanism.star @ at.rotation.T  # Eq. 64
    spin = cross(products.omega, inertia @ products.omega)
    n_ext = np.asarray(moment, dtype=float)
    t1 = at.j.T @ (-inertia @ at.j)  # Eq. 66
    t2 = at.j.T @ (-inertia @ products.omega_dot - spin + n_ext)  # Eq. 67
    ja, jipl = link_jacobians(at)
    first, second = link_frames(at)
    for k in range(3):
        turn = second[k].T @ first[k]
        r = second[k].T @ at.r[k]
        ia = mechanism.actuated[k]
        iipl = mechanism.intermediate[k]
        omega_a = ja[k] @ rate
        omega_ipl = jipl[k] @ rate
        big_l = -ia @ ja[k]  # Eq. 73
        small_l = -cross(omega_a, ia @ omega_a)  # Eq. 74
        big_p = turn @ ja[k] + np.outer(r, at.r[k] @ at.j)  # Eq. 78
        mu_dot = at.a[k] @ rate
        small_p = -cross(turn @ omega_a, r * mu_dot) - products.mu_ddot[k] * r  # Eq. 79
        big_k = -iipl @ big_p  # Eq. 81
        small_k = -iipl @ small_p - cross(omega_ipl, iipl @ omega_ipl)  # Eq. 82
        t1 += ja[k].T @ big_l + jipl[k].T @ big_k  # Eq. 91
        t2 += ja[k].T @ small_l + jipl[k].T @ small_k  # Eq. 92
    return t1, t2


def direct_dynamics(
    mechanism: Mechanism,
    at: Posture,
    gamma_dot: VectorLike,
    torque: VectorLike,
    moment: VectorLike = ZERO,
) -> Array:
    """gamma_ddot [rad/s^2], shape (3,), of actuator torques [N m], Eq. 90."""
    t1, t2 = equation_of_motion(mechanism, at, gamma_dot, moment)
    return np.asarray(np.linalg.solve(-t1, t2 + np.asarray(torque, dtype=float)))


def inverse_dynamics(
    mechanism: Mechanism,
    at: Posture,
    gamma_dot: VectorLike,
    gamma_ddot: VectorLike,
    moment: VectorLike = ZERO,
) -> Array:
    """Actuator torques [N m], shape (3,), that give gamma_ddot [rad/s^2], Eq. 90."""
    t1, t2 = equation_of_motion(mechanism, at, gamma_dot, moment)
    return np.asarray(-(t1 @ np.asarray(gamma_ddot, dtype=float) + t2))
