# SPDX-License-Identifier: Apache-2.0
"""The constant vectors of a manipulator, and arithmetic of arrays of three numbers.

Vectors lie along the last axis; rotations are matrices, quaternions (x, y, z, w) or ZYZ
angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

# `np.unique` imports it in its first call. A process forked meanwhile by another thread
# would wait for the end of this import, which it never sees.
import numpy.ma
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import check_kinds, refuse_unless
from sst_ros.state import Array as Array
from sst_ros.state import Explained

SCENE_KEYS = ("base.v", "star.alpha_deg", "workspace.beta_max_deg")
"""Numbers of a scene that its geometry is made from."""

SMALL = 1000  # numbers of an array below which `take` is faster than slices
NEXT = np.array([1, 2, 0])  # components after x, y, z
LAST = np.array([2, 0, 1])  # components before them
CYCLIC = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
"""Legs, or axes, each with the two that follow it."""


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
    #: lengths of the base arcs P_k P_k+1, upper ends of the strokes [rad], shape (3,)
    arc: Array
    beta_max: Any  #: largest admissible beta_k [rad]

    def _facts(self) -> dict[str, object]:
        arcs_deg = np.degrees(self.arc)
        alpha_deg = np.degrees(self.alpha)
        facts: dict[str, object] = {}
        if self.v.ndim > 2:  # many geometries, of which the first is shown
            facts["geometries"] = len(self.v)
            arcs_deg = arcs_deg[0]
            alpha_deg = alpha_deg[0]
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
        if not hasattr(scene, "star"):  # the class `Scene` itself has none either
            refuse_unless("geometry", ("scene", scene, False, "must be a Scene"))
        return _recent(scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg)

    @classmethod
    @check_kinds
    def build(
        cls, v: ArrayLike, alpha: ArrayLike, beta_max: ArrayLike = np.pi / 2
    ) -> Geometry:
        """Derive the geometry from directions v, shape (3, 3), and angles alpha, (3,).

        The angles are in radians. Shapes (n, 3, 3), (n, 3) and (n,) of beta_max [rad]
        give n geometries.

        The sense of the star (t_k+1 = Rot(s, +alpha_k) t_k) is the one that has
        admissible assemblies over a right-handed base triangle. InputError refuses
        other shapes.
        """
        directions = np.array(v, dtype=float)
        shape = directions.shape
        alpha_shape = np.shape(alpha)
        beta_shape = np.shape(beta_max)
        fits = shape[-2:] == (3, 3) and alpha_shape == shape[:-1]
        fits = fits and beta_shape in ((), shape[:-2])
        shapes = (shape, alpha_shape, beta_shape)
        requirement = "must have the shapes (3, 3), (3,) and ()"
        refuse_unless("geometry", ("v, alpha, beta_max", shapes, fits, requirement))
        directions /= np.linalg.norm(directions, axis=-1)[..., None]
        following = np.roll(directions, -1, axis=-2)
        normals = np.cross(directions, following)
        sines = np.linalg.norm(normals, axis=-1)
        cosines = np.einsum("...j,...j->...", directions, following)
        angles = np.array(alpha, dtype=float)
        alpha_12 = angles[..., 0]
        alpha_23 = angles[..., 1]
        zero = np.zeros_like(alpha_12)
        turns = vectors(zero, alpha_12, alpha_12 + alpha_23)
        e = vectors(-np.sin(turns), np.cos(turns), np.zeros_like(turns))
        w = normals / sines[..., None]
        arcs = np.arctan2(sines, cosines)
        largest: Any = beta_max if beta_shape else float(np.asarray(beta_max))
        frozen(directions, w, e, angles, arcs)
        return cls(directions, w, e, angles, arcs, largest)

    @classmethod
    def of_scenarios(cls, scenarios: Any) -> tuple[Geometry, NDArray[np.intp]]:
        """Derive the distinct geometries of `Scenarios`, and which each row has."""
        scene = scenarios.document
        columns_by_key = [scenarios.rows.get(key) for key in SCENE_KEYS]
        varied = []
        for values in columns_by_key:
            if values is not None:
                varied.append(values.reshape(len(values), -1))
        if not varied:
            return cls.of(scene), np.zeros(scenarios.count or 1, dtype=np.intp)
        _, first_rows, geometry_of_row = np.unique(
            np.hstack(varied), axis=0, return_index=True, return_inverse=True
        )
        nominal = scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg
        arrays = []
        for values, value in zip(columns_by_key, nominal, strict=True):
            if values is None:
                arrays.append(np.repeat([value], len(first_rows), axis=0))
            else:
                arrays.append(values[first_rows])
        v, alpha_deg, beta_max_deg = arrays
        distinct = cls.build(v, np.radians(alpha_deg), np.radians(beta_max_deg))
        if len(first_rows) == 1:  # one for all rows: its numbers are no columns
            distinct = cls.build(distinct.v[0], distinct.alpha[0], distinct.beta_max[0])
        return distinct, geometry_of_row.ravel()

    def of_rows(self, rows: Any) -> Geometry:
        """Return the geometries of rows, or of a row; a single one is that of all."""
        if self.v.ndim == 2:
            return self
        return Geometry(*(array[rows] for array in vars(self).values()))

    def of_leg(self, name: str, k: int) -> Any:
        """Return the row of leg k as floats, or as columns of many geometries."""
        array = getattr(self, name)
        if self.v.ndim == 2:
            return array[k].tolist()
        return np.ascontiguousarray(array[:, k].T)


@lru_cache(maxsize=64)
def _recent(v: Any, alpha_deg: Any, beta_max_deg: float) -> Geometry:
    """Build a geometry, or give the one that was built before from the same numbers."""
    return Geometry.build(v, np.radians(alpha_deg), np.radians(beta_max_deg))


def rotation_matrix(quaternion: ArrayLike) -> Array:
    """Return the rotation R of {E} in {B}, shape (..., 3, 3).

    The quaternions (x, y, z, w) have the shape (..., 4). A quaternion of length zero
    raises ValueError.
    """
    q = np.asarray(quaternion, dtype=float)
    length = np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    if np.any(length == 0.0):
        raise ValueError("a quaternion of length zero is no rotation")
    x, y, z, w = np.moveaxis(q / length, -1, 0)
    xx = x * x
    yy = y * y
    zz = z * z
    ww = w * w
    rows = [
        vectors(xx - yy - zz + ww, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)),
        vectors(2.0 * (x * y + z * w), -xx + yy - zz + ww, 2.0 * (y * z - x * w)),
        vectors(2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -xx - yy + zz + ww),
    ]
    return np.stack(rows, axis=-2)


def quaternion_of(rotation: ArrayLike) -> Array:
    """Quaternions (x, y, z, w) with w >= 0, shape (..., 4), of rotation matrices.

    The matrices have the shape (..., 3, 3). The largest component comes from the
    diagonal (Markley, J. Guid. Control Dyn. 31 (2008) 440-442). Where w is zero, the
    first other component that is not is positive.
    """
    m = np.asarray(rotation, dtype=float)
    trace = np.trace(m, axis1=-2, axis2=-1)
    w = 3  # index of the real part; i, j, k are those of the others
    # Row n is four times component n times the whole quaternion.
    *stack_shape, _, _ = m.shape
    products = np.empty((*stack_shape, 4, 4))
    for i, j, k in CYCLIC:
        products[..., i, i] = 1.0 - trace + 2.0 * m[..., i, i]
        products[..., i, j] = m[..., j, i] + m[..., i, j]
        products[..., i, k] = m[..., k, i] + m[..., i, k]
        products[..., i, w] = m[..., k, j] - m[..., j, k]
        products[..., w, i] = products[..., i, w]
    products[..., w, w] = 1.0 + trace
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)
    sizes = np.concatenate([diagonal, trace[..., None]], axis=-1)
    largest = np.argmax(sizes, axis=-1)
    row = np.take_along_axis(products, largest[..., None, None], axis=-2)
    q = np.squeeze(row, axis=-2)
    q = q / np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    signs = np.sign(np.roll(q, 1, axis=-1))  # w first
    first = np.argmax(signs != 0.0, axis=-1)
    sign = np.take_along_axis(signs, first[..., None], axis=-1)
    return np.asarray(np.where(sign < 0.0, -q, q))


def zyz_angles(rotation: ArrayLike) -> Array:
    """ZYZ angles [rad], shape (..., 3), of rotations (..., 3, 3), Eqs. 3 and 6 to 8.

    R = Rz(theta) Ry(phi) Rz(psi). theta and psi are in (-pi, pi], phi in [0, pi]. Where
    sin(phi) = 0 only theta + psi (phi = 0) or theta - psi (phi = pi) exists; there
    theta is 0 and psi carries it all.
    """
    r = np.asarray(rotation, dtype=float)
    s_x, s_y, s_z = np.moveaxis(r[..., :, 2], -1, 0)
    sine = np.hypot(s_x, s_y)
    pole = sine == 0.0
    theta = np.where(pole, 0.0, np.arctan2(s_y, s_x))
    psi = np.where(
        pole,
        np.arctan2(r[..., 1, 0], r[..., 1, 1]),
        np.arctan2(r[..., 2, 1], -r[..., 2, 0]),
    )
    return vectors(theta, np.arctan2(sine, s_z), psi)


def unwrap_zyz(angles: ArrayLike) -> Array:
    """Return ZYZ angles [rad] of a trajectory without jumps, shape (n, 3).

    `angles` are as `zyz_angles` returns them.

    (theta, phi, psi) and (theta + pi, -phi, psi + pi) are the same rotation, so a
    motion straight through the pole is smooth in angles if phi may change its sign.
    Each sample takes that of the two forms, give or take full turns, that is nearest to
    the sample before; the first one off the pole is as given. At the pole itself
    (sin(phi) = 0, theta = 0) theta stays what it was and psi takes the rest, so theta +
    psi at phi = 0 and theta - psi at phi = pi are kept.
    """
    result = np.array(angles, dtype=float)
    off_pole = np.flatnonzero(~np.isin(result[:, 1], (0.0, np.pi)))
    start = int(off_pole[0]) if len(off_pole) else 0
    for row in range(start + 1, len(result)):
        result[row] = _nearest_form(result[row], result[row - 1])
    for row in range(start - 1, -1, -1):
        result[row] = _nearest_form(result[row], result[row + 1])
    return result


def _nearest_form(angles: Array, reference: Array) -> Array:
    """Return the form of ZYZ angles that is nearest to a reference, shape (3,) each."""
    theta, phi, psi = angles
    half_turn = np.pi
    if phi in (0.0, np.pi):
        half_turn = 0.0
        shift = reference[0] - theta
        theta = reference[0]
        # Kept is theta + psi at phi = 0, theta - psi at phi = pi.
        psi = psi - shift if phi == 0.0 else psi + shift
    forms = np.array([[theta, phi, psi], [theta + half_turn, -phi, psi + half_turn]])
    full_turn = 2.0 * np.pi
    forms += full_turn * np.round((reference - forms) / full_turn)
    distances = np.abs(forms - reference).sum(axis=1)
    return np.asarray(forms[np.argmin(distances)])


def star_direction(rotation: Array) -> Array:
    """Return s, the direction of E in {B}: the third column of R, shape (..., 3)."""
    return rotation[..., :, 2]


def angle_between(first: ArrayLike, second: ArrayLike) -> Array:
    """Angle of the rotation between quaternions [rad], shape (...,); exact if tiny."""
    a = np.asarray(first)
    b = np.asarray(second)
    same_sign = np.linalg.norm(a - b, axis=-1)
    other_sign = np.linalg.norm(a + b, axis=-1)
    chord = np.minimum(same_sign, other_sign)
    return np.asarray(4.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))


def cross(a: Array, b: Array) -> Array:
    """Vector product along the last axis; much faster than np.cross on small arrays."""
    if a.size < SMALL:
        first = a.take(NEXT, -1) * b.take(LAST, -1)
        second = a.take(LAST, -1) * b.take(NEXT, -1)
        return np.asarray(first - second)
    ax, ay, az = np.moveaxis(a, -1, 0)
    bx, by, bz = np.moveaxis(b, -1, 0)
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = ay * bz - az * by
    product[..., 1] = az * bx - ax * bz
    product[..., 2] = ax * by - ay * bx
    return product


def dot(a: Array, b: Array) -> Array:
    """Scalar product along the last axis, of three; much faster than np.sum."""
    product = a * b
    x = product[..., 0]
    y = product[..., 1]
    z = product[..., 2]
    return np.asarray(x + y + z)


def norm(a: Array) -> Array:
    """Length along the last axis, of three."""
    return np.asarray(np.sqrt(dot(a, a)))


def vectors(x: Array, y: Array, z: Array) -> Array:
    """Vectors (..., 3) with the given components."""
    return np.stack([x, y, z], axis=-1)


def columns(a: Array, b: Array, c: Array) -> Array:
    """Matrices (..., 3, 3) with the given columns."""
    matrices = np.empty((*a.shape, 3))
    matrices[..., 0] = a
    matrices[..., 1] = b
    matrices[..., 2] = c
    return matrices
