# SPDX-License-Identifier: Apache-2.0
"""Positions: orientation -> joint angles, and actuator angles -> every orientation.

A leg holds t_k at a right angle to r_k; that is all there is to the position problem:
r_k(gamma_k) . R e_k = 0 for k = 1, 2, 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eig

from sst_ros.errors import AmbiguousAssembly, AssemblyError, NoAdmissibleAssembly
from sst_ros.mechanism.geometry import Array, Geometry

RESIDUAL = 1e-14
"""Largest abs(r_k . t_k) of an assembly that is told to be one."""

_NEAR_REAL = 1e-5
_SAME = 1e-7
_NEWTON_STEPS = 12


@dataclass(frozen=True)
class Assembly:
    """One way to assemble the manipulator at given actuator angles.

    Attributes:
        rotation: R of {E} in {B}, shape (3, 3).
        mu: angles of the passive revolute joints in (-pi, pi] [rad], shape (3,).
        beta: angles of the passive curved prismatic joints in (-pi, pi] [rad], shape (3,).
        det_j2: determinant of J2, zero at a parallel singularity.
        admissible: E lies on the base triangle (Eq. 4) with 0 < beta_k <= beta_max for all legs.

    """

    rotation: Array
    mu: Array
    beta: Array
    det_j2: float
    admissible: bool


def carriage_directions(geometry: Geometry, gamma: ArrayLike) -> Array:
    """Directions r_k of the intermediate joints in {B}, Eq. 1, shape (3, 3), rows by leg."""
    angles = np.asarray(gamma, dtype=float)[:, None]
    across = np.cross(geometry.w, geometry.v)
    return np.asarray(np.cos(angles) * geometry.v + np.sin(angles) * across)


def inverse(geometry: Geometry, rotation: ArrayLike) -> tuple[Array, Array, Array]:
    """Joint angles (gamma, mu, beta) [rad], each shape (3,), of an orientation R.

    Of the two intersections of the planes w_k and t_k, r_k = t_k x w_k / sin(mu_k) is taken: the
    branch with mu_k in (0, pi), which all admissible assemblies have and on which beta_k changes
    sign smoothly at the edge of the workspace. Where t_k = +-w_k (serial singularity) gamma_k has
    no value and comes out as 0.
    """
    t = geometry.e @ np.asarray(rotation, dtype=float).T
    p = np.cross(t, geometry.w)
    sine = np.linalg.norm(p, axis=1)
    gamma = np.arctan2(_dot(p, np.cross(geometry.w, geometry.v)), _dot(p, geometry.v))
    mu = np.arctan2(sine, _dot(t, geometry.w))
    s = np.asarray(rotation, dtype=float)[:, 2]
    beta = np.arctan2(_dot(p, np.cross(t, s)), p @ s)
    return gamma, mu, beta


def assembly_of(geometry: Geometry, gamma: ArrayLike, rotation: Array) -> Assembly:
    """Describe the assembly R at actuator angles gamma; R must close the loops."""
    r = carriage_directions(geometry, gamma)
    t, s = geometry.e @ rotation.T, rotation[:, 2]
    mu = np.arctan2(-_dot(np.cross(geometry.w, t), r), _dot(geometry.w, t))
    beta = np.arctan2(_dot(r, np.cross(t, s)), r @ s)
    inside = bool(np.all(geometry.w @ s > 0.0))
    admissible = inside and bool(np.all((beta > 0.0) & (beta <= geometry.beta_max)))
    return Assembly(rotation, mu, beta, -float(np.linalg.det(np.cross(r, t))), admissible)


def direct(geometry: Geometry, gamma: ArrayLike) -> list[Assembly]:
    """All real assemblies at actuator angles gamma [rad], shape (3,); up to eight.

    t_1 = cos(x) n + sin(x) m spans the plane across r_1 and s = cos(y) r_1 + sin(y) t_1 x r_1.
    The other two legs are then linear in (cos y, sin y), which leaves one quartic in tan(x). Its
    roots come from an eigenvalue problem, each is polished on the rotation itself, and t_1 and
    -t_1 give two assemblies that share s.

    Raises:
        AssemblyError: gamma is not finite, or the assemblies are not isolated.

    """
    angles = np.asarray(gamma, dtype=float)
    if angles.shape != (3,) or not np.all(np.isfinite(angles)):
        raise AssemblyError("gamma must be three finite numbers", angles)
    r = carriage_directions(geometry, angles)
    n = np.cross(r[0], np.eye(3)[np.argmin(np.abs(r[0]))])
    n /= np.linalg.norm(n)
    m = np.cross(r[0], n)
    # Coefficients of (cos x, sin x) in r_k . (t_1 x r_1) and in r_k . t_1, for legs 2 and 3.
    p = np.stack([r[1:] @ np.cross(n, r[0]), r[1:] @ np.cross(m, r[0])], axis=1)
    q = np.stack([r[1:] @ n, r[1:] @ m], axis=1)
    rho, ex, ey = r[1:] @ r[0], geometry.e[1:, 0], geometry.e[1:, 1]
    found: list[Array] = []
    for x in _quartic_angles(p, q, rho, ex, ey, angles):
        t1 = np.cos(x) * n + np.sin(x) * m
        for y in _leg_angles(x, p, q, rho, ex, ey):
            s = np.cos(y) * r[0] + np.sin(y) * np.cross(t1, r[0])
            rotation = _polish(geometry, r, np.stack([np.cross(t1, s), t1, s], axis=1))
            if rotation is not None:
                turned = rotation * np.array([-1.0, -1.0, 1.0])
                known = (np.abs(rotation - other).max() > _SAME for other in found)
                if all(known):
                    found += [rotation, turned]
    return [assembly_of(geometry, angles, rotation) for rotation in found]


def admissible(geometry: Geometry, gamma: ArrayLike) -> Assembly:
    """Return the one assembly in which the manipulator can be built at gamma, section 4.1.

    Raises:
        NoAdmissibleAssembly: no assembly has E on the base triangle and 0 < beta_k <= beta_max.
        AmbiguousAssembly: more than one has; the error carries them.
        AssemblyError: gamma is not finite, or the assemblies are not isolated.

    """
    candidates = [assembly for assembly in direct(geometry, gamma) if assembly.admissible]
    angles = np.asarray(gamma, dtype=float)
    if not candidates:
        raise NoAdmissibleAssembly("no admissible assembly", angles)
    if len(candidates) > 1:
        raise AmbiguousAssembly(angles, candidates)
    return candidates[0]


def _quartic_angles(
    p: Array, q: Array, rho: Array, ex: Array, ey: Array, gamma: Array
) -> list[float]:
    """Angles x in (-pi/2, pi/2] of the real roots; x and x + pi are the same pair."""
    a, b, c = ex[:, None] * p, -ex * rho, ey[:, None] * q
    # Rows a_k cos y + b_k sin y + c_k = 0; their cross product is (cos y, sin y, 1) up to scale.
    cosine = b[0] * c[1] - b[1] * c[0]
    sine = np.convolve(c[0], a[1]) - np.convolve(a[0], c[1])
    one = a[0] * b[1] - a[1] * b[0]
    circle = np.array([1.0, 0.0, 1.0])
    form = np.convolve(np.convolve(cosine, cosine) - np.convolve(one, one), circle)
    form = form + np.convolve(sine, sine)
    scale = np.abs(form).max()
    if scale < 1e-13:
        raise AssemblyError("the assemblies are not isolated", gamma)
    left, right = np.diag(np.ones(3), 1), np.eye(4)
    left[3], right[3, 3] = -form[:4] / scale, form[4] / scale
    sines, cosines = eig(left, right, right=False, homogeneous_eigvals=True)
    angles = []
    for up, down in zip(sines, cosines, strict=True):
        cross, size = up * np.conj(down), abs(up) ** 2 + abs(down) ** 2
        if abs(cross.imag) < _NEAR_REAL * size:
            angles.append(0.5 * np.arctan2(2.0 * cross.real, abs(down) ** 2 - abs(up) ** 2))
    return angles


def _leg_angles(x: float, p: Array, q: Array, rho: Array, ex: Array, ey: Array) -> list[float]:
    """Angles y that fit both legs at x; two of them where legs 2 and 3 ask for the same."""
    direction = np.array([np.cos(x), np.sin(x)])
    rows = np.stack([ex * (p @ direction), -ex * rho, ey * (q @ direction)], axis=1)
    a, b, c = rows[np.argmax(np.hypot(rows[:, 0], rows[:, 1]))]
    reach, middle = np.hypot(a, b), np.arctan2(b, a)
    swing = np.arccos(np.clip(-c / reach, -1.0, 1.0))
    candidates = [middle + swing, middle - swing]
    misfit = [np.abs(rows @ [np.cos(y), np.sin(y), 1.0]).max() for y in candidates]
    return [y for y, miss in zip(candidates, misfit, strict=True) if miss < 1e-2]


def _polish(geometry: Geometry, r: Array, rotation: Array) -> Array | None:
    """Newton's method on SO(3) for r_k . R e_k = 0; None where it does not settle."""
    for _ in range(_NEWTON_STEPS):
        t = geometry.e @ rotation.T
        residual = _dot(r, t)
        step = np.asarray(np.linalg.lstsq(np.cross(t, r), -residual, rcond=1e-9)[0], dtype=float)
        turn = float(np.linalg.norm(step))
        if np.abs(residual).max() <= RESIDUAL and turn < _SAME:
            return rotation
        if turn > 0.5:
            return None
        rotation = _turned(rotation, step)
    return rotation if np.abs(_dot(r, geometry.e @ rotation.T)).max() <= RESIDUAL else None


def _turned(rotation: Array, step: Array) -> Array:
    """Turn R by the small rotation vector `step` in {B} and make it orthonormal again."""
    moved = rotation + np.cross(step, rotation, axisb=0).T
    s = moved[:, 2] / np.linalg.norm(moved[:, 2])
    t = moved[:, 1] - s * (s @ moved[:, 1])
    t /= np.linalg.norm(t)
    return np.stack([np.cross(t, s), t, s], axis=1)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", a, b))
