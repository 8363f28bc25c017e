# SPDX-License-Identifier: Apache-2.0
"""Positions: orientation -> joint angles, and actuator angles -> every orientation.

A leg holds t_k at a right angle to r_k; that is all there is to the position problem:
r_k(gamma_k) . R e_k = 0 for k = 1, 2, 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import AmbiguousAssembly, AssemblyError, NoAdmissibleAssembly
from sst_ros.mechanism.direct_kinematics import cross, dot, rotations
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry, frozen
from sst_ros.state import Assembly

NEAR = 0.1
"""How near an assembly must be to the rotation that names it [rad]."""


@dataclass(frozen=True)
class Assemblies:
    """The assemblies of many gamma at once; m of them for n configurations. Read-only arrays.

    Attributes:
        configuration: row of gamma that each assembly belongs to, ascending, shape (m,).
        rotation, mu, beta, det_j2, admissible: as in `Assembly`, with m first.
        isolated: shape (n,); False where gamma has a continuum of assemblies, of which none is
            listed.

    """

    configuration: NDArray[np.intp]
    rotation: Array
    mu: Array
    beta: Array
    det_j2: Array
    admissible: NDArray[np.bool_]
    isolated: NDArray[np.bool_]


def carriage_directions(geometry: Geometry, gamma: ArrayLike) -> Array:
    """Directions r_k of the intermediate joints in {B}, Eq. 1, shape (..., 3, 3), rows by leg."""
    angles = np.asarray(gamma, dtype=float)[..., None]
    across = cross(geometry.w, geometry.v)
    return np.asarray(np.cos(angles) * geometry.v + np.sin(angles) * across)


def closure(geometry: Geometry, gamma: ArrayLike, rotation: ArrayLike) -> Array:
    """Products r_k . R e_k of gamma (..., 3) [rad] and R (..., 3, 3), zero in closed loops."""
    t = geometry.e @ np.swapaxes(np.asarray(rotation, dtype=float), -1, -2)
    return dot(carriage_directions(geometry, gamma), t)


def inverse(
    geometry: Geometry, rotation: ArrayLike, signs: Sequence[int] = (1, 1, 1)
) -> tuple[Array, Array, Array]:
    """Joint angles (gamma, mu, beta) [rad], each shape (..., 3), of orientations R (..., 3, 3).

    The planes across w_k and t_k meet in one line, so every leg has two solutions, r_k and -r_k,
    and an orientation has eight:

    - sign +1, r_k = t_k x w_k / sin(mu_k): mu_k in (0, pi). All admissible assemblies have it, and
      on it beta_k changes sign smoothly at the edge of the workspace.
    - sign -1, -r_k: gamma_k + pi, -mu_k and beta_k + pi, wrapped to (-pi, pi].

    Where t_k = +-w_k (serial singularity) every gamma_k fits and it comes out as 0.
    """
    matrices = np.asarray(rotation, dtype=float)
    t, s = geometry.e @ np.swapaxes(matrices, -1, -2), matrices[..., None, :, 2]
    p = cross(t, geometry.w)
    sine = np.sqrt(dot(p, p))
    sign = np.asarray(signs, dtype=float)
    p = sign[:, None] * p
    gamma = np.arctan2(dot(p, cross(geometry.w, geometry.v)), dot(p, geometry.v))
    mu = np.arctan2(sign * sine, dot(t, geometry.w))
    beta = np.arctan2(dot(p, cross(t, s)), dot(p, s))
    return gamma, mu, beta


def direct(geometry: Geometry, gamma: ArrayLike) -> list[Assembly]:
    """All real assemblies at actuator angles gamma [rad], shape (3,); up to eight.

    They come in pairs R, R Rot(z, pi), in the order of (s_z, s_y, s_x) of their shared s. Two
    assemblies nearer than some 1e-7 rad are a double root in this arithmetic and come out as one
    with det J2 near 0; see `assemblies`.

    Raises:
        AssemblyError: gamma is not finite, or the assemblies are not isolated.

    """
    angles = np.array(gamma, dtype=float)
    if angles.shape != (3,) or not np.all(np.isfinite(angles)):
        raise AssemblyError("gamma must be three finite numbers", angles)
    found = direct_many(geometry, angles[None])
    if not found.isolated[0]:
        raise AssemblyError("the assemblies are not isolated", angles)
    rows = zip(found.rotation, found.mu, found.beta, found.det_j2, found.admissible, strict=True)
    return [Assembly(*row[:3], float(row[3]), bool(row[4])) for row in rows]


def direct_many(geometry: Geometry, gamma: ArrayLike) -> Assemblies:
    """All real assemblies of many gamma [rad], shape (n, 3), at once; the order is `direct`'s.

    The geometry may be one for each of them.

    Raises:
        AssemblyError: gamma is not (n, 3) finite numbers.

    """
    angles = np.asarray(gamma, dtype=float)
    if angles.ndim != 2 or angles.shape[1] != 3 or not np.all(np.isfinite(angles)):
        raise AssemblyError("gamma must be rows of three finite numbers", angles)
    r = carriage_directions(geometry, angles)
    configuration, rotation, isolated = rotations(r, geometry.e)
    mu, beta, det_j2, admissible = described(
        geometry.of_rows(configuration), r[configuration], rotation
    )
    arrays = frozen(configuration, rotation, mu, beta, det_j2, admissible, isolated)
    return Assemblies(*arrays)


def admissible(geometry: Geometry, gamma: ArrayLike, near: ArrayLike | None = None) -> Assembly:
    """Return the one assembly in which the manipulator can be built at gamma, section 4.1.

    Args:
        geometry: base triangle and star.
        gamma: actuator angles [rad], shape (3,).
        near: rotation that selects one where several are admissible: the only one
            within NEAR of it.

    Raises:
        NoAdmissibleAssembly: no assembly has E on the base triangle and 0 < beta_k <= beta_max.
        AmbiguousAssembly: more than one has, and `near` names none; the error carries them.
        AssemblyError: gamma is not finite, or the assemblies are not isolated.

    """
    candidates = [assembly for assembly in direct(geometry, gamma) if assembly.admissible]
    angles = np.asarray(gamma, dtype=float)
    if not candidates:
        raise NoAdmissibleAssembly("no admissible assembly", angles)
    if len(candidates) > 1:
        meant = [one for one in candidates if near is not None and _apart(one, near) < NEAR]
        if len(meant) == 1:
            return meant[0]
        orientations = quaternion_of(np.stack([one.rotation for one in candidates]))
        raise AmbiguousAssembly(angles, candidates, orientations)
    return candidates[0]


def _apart(assembly: Assembly, near: ArrayLike) -> float:
    """Angle of the rotation between an assembly and `near` [rad]."""
    trace = float(np.sum(assembly.rotation * np.asarray(near, dtype=float)))
    return float(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def described(
    geometry: Geometry, r: Array, rotation: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Passive angles mu, beta (..., 3) [rad], det J2 and admissibility (...) of assemblies.

    Args:
        geometry: base triangle and star.
        r: carriage directions in rows, shape (..., 3, 3).
        rotation: R, shape (..., 3, 3), with r_k . R e_k = 0.

    """
    t, s = geometry.e @ np.swapaxes(rotation, -1, -2), rotation[..., None, :, 2]
    mu = np.arctan2(dot(cross(t, geometry.w), r), dot(geometry.w, t))
    beta = np.arctan2(dot(r, cross(t, s)), dot(r, s))
    normal = cross(r, t)
    volume = dot(normal[..., 0, :], cross(normal[..., 1, :], normal[..., 2, :]))
    edge = dot(np.broadcast_to(s, t.shape), geometry.w) > 0.0
    most = np.asarray(geometry.beta_max)[..., None]
    valid = np.all(edge & (beta > 0.0) & (beta <= most), axis=-1)
    return mu, beta, -volume, valid
