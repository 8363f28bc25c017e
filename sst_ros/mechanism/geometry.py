# SPDX-License-Identifier: Apache-2.0
"""The constant vectors of one manipulator, and the arrays of three numbers that all rooms use.

Vectors lie along the last axis; rotations are matrices, quaternions (x, y, z, w) or ZYZ
angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.state import Array as Array
from sst_ros.state import Explained

# what a geometry is made from
_KEYS = ("base.v", "star.alpha_deg", "workspace.beta_max_deg")
_SMALL = 1000  # numbers of an array below which `take` is faster than slices
_AHEAD, _BEHIND = np.array([1, 2, 0]), np.array([2, 0, 1])


def frozen(*arrays: Any) -> tuple[Any, ...]:
    """Make arrays read-only, and return them."""
    for array in arrays:
        array.setflags(write=False)
    return arrays


@dataclass(frozen=True, repr=False)
class Geometry(Explained):
    """Base triangle and star; rows belong to legs. All arrays are read-only.

    Many geometries are one object whose arrays have one more axis in front.
    """

    v: Array  #: unit vectors O P_k in {B}, shape (3, 3)
    w: Array  #: actuator axes, Eq. 1, shape (3, 3)
    e: Array  #: axes t_k of the star's arcs in {E}, shape (3, 3); t_k = R e_k
    alpha: Array  #: angles between the arcs [rad], shape (3,)
    #: lengths of the base arcs P_k P_k+1, the upper ends of the stroke [rad], (3,)
    arc: Array
    beta_max: Any  #: largest admissible beta_k [rad]

    def _facts(self) -> dict[str, object]:
        arcs_deg, alpha_deg = np.degrees(self.arc), np.degrees(self.alpha)
        facts: dict[str, object] = {}
        if self.v.ndim > 2:
            facts["geometries"] = len(self.v)
            arcs_deg, alpha_deg = arcs_deg[0], alpha_deg[0]
        else:
            for leg, vertex in enumerate(self.v.tolist(), start=1):
                facts[f"P{leg} in {{B}}, unit vector"] = vertex
        facts["base arcs P1 P2, P2 P3, P3 P1 [deg]"] = arcs_deg.tolist()
        facts["angles of the star [deg]"] = alpha_deg.tolist()
        facts["largest beta [deg]"] = float(np.degrees(np.ravel(self.beta_max)[0]))
        return facts

    @classmethod
    def of(cls, scene: Any) -> Geometry:
        """Derive the geometry of a `Scene`."""
        if not hasattr(scene, "star"):  # nor has its class
            refuse_unless("geometry", ("scene", scene, False, "must be a Scene"))
        return _recent(scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg)

    @classmethod
    @check_kinds
    def build(
        cls, v: ArrayLike, alpha: ArrayLike, beta_max: ArrayLike = np.pi / 2
    ) -> Geometry:
        """Derive the geometry from directions v, shape (3, 3), and angles alpha [rad], (3,).

        Shapes (n, 3, 3), (n, 3) and (n,) of beta_max [rad] give n geometries.

        The sense of the star (t_k+1 = Rot(s, +alpha_k) t_k) is the one that has
        admissible assemblies over a right-handed base triangle. InputError refuses
        other shapes.
        """
        directions = np.array(v, dtype=float)
        shapes = v_shape, *others = (
            directions.shape,
            np.shape(alpha),
            np.shape(beta_max),
        )
        good = v_shape[-2:] == (3, 3) and others[0] == v_shape[:-1]
        good = good and others[1] in ((), v_shape[:-2])
        allowed = "must have the shapes (3, 3), (3,) and ()"
        refuse_unless("geometry", ("v, alpha, beta_max", shapes, good, allowed))
        directions /= np.linalg.norm(directions, axis=-1)[..., None]
        following = np.roll(directions, -1, axis=-2)
        normals = np.cross(directions, following)
        sines = np.linalg.norm(normals, axis=-1)
        cosines = np.einsum("...j,...j->...", directions, following)
        angles = np.array(alpha, dtype=float)
        first, second = angles[..., 0], angles[..., 1]
        f = np.stack([np.zeros_like(first), first, first + second], axis=-1)
        e = np.stack([-np.sin(f), np.cos(f), np.zeros_like(f)], axis=-1)
        most: Any = beta_max if others[1] else float(np.asarray(beta_max))
        arrays = (
            directions,
            normals / sines[..., None],
            e,
            angles,
            np.arctan2(sines, cosines),
        )
        frozen(*arrays)
        return cls(*arrays, most)

    @classmethod
    def of_scenarios(cls, scenarios: Any) -> tuple[Geometry, NDArray[np.intp]]:
        """Derive the distinct geometries of `Scenarios`, and the index of that of each row."""
        scene, rows = scenarios.document, [scenarios.rows.get(key) for key in _KEYS]
        varied = [
            values.reshape(len(values), -1) for values in rows if values is not None
        ]
        if not varied:
            return cls.of(scene), np.zeros(scenarios.count or 1, dtype=np.intp)
        _, first, index = np.unique(
            np.hstack(varied), axis=0, return_index=True, return_inverse=True
        )
        nominal = scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg
        v, alpha, beta = (
            np.repeat([value], len(first), axis=0) if values is None else values[first]
            for values, value in zip(rows, nominal, strict=True)
        )
        found = cls.build(v, np.radians(alpha), np.radians(beta))
        if len(first) == 1:  # one for all rows: its numbers are no columns
            found = cls.build(found.v[0], found.alpha[0], found.beta_max[0])
        return found, index.ravel()

    def of_rows(self, rows: Any) -> Geometry:
        """Return the geometries of rows, or of a row.

        This one where it is a single one.
        """
        if self.v.ndim == 2:
            return self
        return Geometry(*(array[rows] for array in vars(self).values()))

    def of_leg(self, name: str, k: int) -> Any:
        """Return what an array has for leg k as floats, or as columns of many geometries."""
        array = getattr(self, name)
        if self.v.ndim == 2:
            return array[k].tolist()
        return np.ascontiguousarray(array[:, k].T)


@lru_cache(maxsize=64)
def _recent(v: Any, alpha_deg: Any, beta_max_deg: float) -> Geometry:
    """Build a geometry, or give the one that was built before from the same numbers."""
    return Geometry.build(v, np.radians(alpha_deg), np.radians(beta_max_deg))


def rotation_matrix(quaternion: ArrayLike) -> Array:
    """Rotation R of {E} in {B}, shape (..., 3, 3), of quaternions (x, y, z, w), (..., 4).

    A quaternion of length zero raises ValueError.
    """
    q = np.asarray(quaternion, dtype=float)
    length = np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    if np.any(length == 0.0):
        raise ValueError("a quaternion of length zero is no rotation")
    x, y, z, w = np.moveaxis(q / length, -1, 0)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    rows = (
        (xx - yy - zz + ww, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        (2.0 * (x * y + z * w), -xx + yy - zz + ww, 2.0 * (y * z - x * w)),
        (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -xx - yy + zz + ww),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_of(rotation: ArrayLike) -> Array:
    """Quaternions (x, y, z, w) with w >= 0, shape (..., 4), of rotation matrices (..., 3, 3).

    The largest component comes from the diagonal (Markley, J. Guid. Control Dyn. 31
    (2008) 440-442). Where w is zero, the first other component that is not is positive.
    """
    m = np.asarray(rotation, dtype=float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    # four times a row's own component times all four
    found = np.empty((*m.shape[:-2], 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[..., i, i] = 1.0 - trace + 2.0 * m[..., i, i]
        found[..., i, j] = m[..., j, i] + m[..., i, j]
        found[..., i, k] = m[..., k, i] + m[..., i, k]
        found[..., i, 3] = found[..., 3, i] = m[..., k, j] - m[..., j, k]
    found[..., 3, 3] = 1.0 + trace
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], trace], axis=-1)
    largest = np.argmax(diagonal, axis=-1)
    q = np.take_along_axis(found, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    signs = np.sign(np.roll(q, 1, axis=-1))  # w first
    first = np.argmax(signs != 0.0, axis=-1)
    sign = np.take_along_axis(signs, first[..., None], axis=-1)
    return np.asarray(np.where(sign < 0.0, -q, q))


def zyz_angles(rotation: ArrayLike) -> Array:
    """ZYZ angles [rad], (..., 3), of R = Rz(theta) Ry(phi) Rz(psi), (..., 3, 3), Eqs. 3, 6 to 8.

    theta and psi are in (-pi, pi], phi in [0, pi]. Where sin(phi) = 0 only theta + psi
    (phi = 0) or theta - psi (phi = pi) exists; there theta is 0 and psi carries it all.
    """
    r = np.asarray(rotation, dtype=float)
    sine = np.hypot(r[..., 0, 2], r[..., 1, 2])
    pole = sine == 0.0
    theta = np.where(pole, 0.0, np.arctan2(r[..., 1, 2], r[..., 0, 2]))
    psi = np.where(
        pole,
        np.arctan2(r[..., 1, 0], r[..., 1, 1]),
        np.arctan2(r[..., 2, 1], -r[..., 2, 0]),
    )
    return np.stack([theta, np.arctan2(sine, r[..., 2, 2]), psi], axis=-1)


def unwrap_zyz(angles: ArrayLike) -> Array:
    """ZYZ angles [rad] of a trajectory without jumps, shape (n, 3), as from `zyz_angles`.

    (theta, phi, psi) and (theta + pi, -phi, psi + pi) are the same rotation, so a
    motion straight through the pole is smooth in angles if phi may change its sign.
    Each sample takes that of the two forms, give or take full turns, that is nearest to
    the sample before; the first one off the pole is as given. At the pole itself
    (sin(phi) = 0, theta = 0) theta stays what it was and psi takes the rest, so theta +
    psi at phi = 0 and theta - psi at phi = pi are kept.
    """
    result = np.array(angles, dtype=float)
    off = np.flatnonzero(~np.isin(result[:, 1], (0.0, np.pi)))
    start = int(off[0]) if len(off) else 0
    ahead, back = range(start + 1, len(result)), range(start - 1, -1, -1)
    for row in (*ahead, *back):
        before, (theta, phi, psi) = (
            result[row - 1 if row > start else row + 1],
            result[row],
        )
        half_turn = np.pi
        if phi in (0.0, np.pi):
            shift, half_turn = before[0] - theta, 0.0
            theta, psi = before[0], psi + (shift if phi else -shift)
        forms = np.array(
            [[theta, phi, psi], [theta + half_turn, -phi, psi + half_turn]]
        )
        forms += 2.0 * np.pi * np.round((before - forms) / (2.0 * np.pi))
        result[row] = forms[np.argmin(np.abs(forms - before).sum(axis=1))]
    return result


def angle_between(first: ArrayLike, second: ArrayLike) -> Array:
    """Angle of the rotation between quaternions [rad], shape (...,).

    Exact for tiny angles.
    """
    a, b = np.asarray(first), np.asarray(second)
    difference = np.minimum(
        np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    )
    return np.asarray(4.0 * np.arcsin(np.minimum(difference / 2.0, 1.0)))


def cross(a: Array, b: Array) -> Array:
    """Vector product along the last axis; much faster than np.cross on small arrays."""
    if a.size < _SMALL:
        ahead = a.take(_AHEAD, -1) * b.take(_BEHIND, -1)
        return np.asarray(ahead - a.take(_BEHIND, -1) * b.take(_AHEAD, -1))
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0], out[..., 1], out[..., 2] = (
        ay * bz - az * by,
        az * bx - ax * bz,
        ax * by - ay * bx,
    )
    return out


def dot(a: Array, b: Array) -> Array:
    """Scalar product along the last axis, of three; much faster than np.sum."""
    product = a * b
    return np.asarray(product[..., 0] + product[..., 1] + product[..., 2])


def columns(a: Array, b: Array, c: Array) -> Array:
    """Matrices (..., 3, 3) with the given columns."""
    out = np.empty((*a.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = a, b, c
    return out
