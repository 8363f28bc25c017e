# SPDX-License-Identifier: Apache-2.0
"""The constant vectors of one manipulator, derived once from its scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.state import Array

__all__ = ["Array", "Geometry", "frozen"]

_KEYS = ("base.v", "star.alpha_deg", "workspace.beta_max_deg")
"""What a geometry is made from."""


class _Shapes(Protocol):
    """The sections of a `Scene` that a geometry is made from."""

    @property
    def base(self) -> Any: ...

    @property
    def star(self) -> Any: ...

    @property
    def workspace(self) -> Any: ...


def frozen(*arrays: Any) -> tuple[Any, ...]:
    """Make arrays read-only, and return them."""
    for array in arrays:
        array.setflags(write=False)
    return arrays


@dataclass(frozen=True)
class Geometry:
    """Base triangle and star; rows belong to legs. All arrays are read-only.

    Many geometries are one object whose arrays have one more axis in front.
    """

    v: Array  #: unit vectors O P_k in {B}, shape (3, 3)
    w: Array  #: actuator axes, Eq. 1, shape (3, 3)
    e: Array  #: axes t_k of the star's arcs in {E}, shape (3, 3); t_k = R e_k
    alpha: Array  #: angles between the arcs [rad], shape (3,)
    #: lengths of the base arcs P_k P_k+1, the upper ends of the stroke [rad], shape (3,)
    arc: Array
    beta_max: Any  #: largest admissible beta_k [rad]

    @classmethod
    def of(cls, scene: _Shapes) -> Geometry:
        """Derive the geometry of a scene."""
        return _recent(scene.base.v, scene.star.alpha_deg, scene.workspace.beta_max_deg)

    @classmethod
    def build(cls, v: ArrayLike, alpha: ArrayLike, beta_max: Any = np.pi / 2) -> Geometry:
        """Derive the geometry from directions v, shape (3, 3), and angles alpha [rad], (3,).

        Shapes (n, 3, 3), (n, 3) and (n,) of beta_max [rad] give n geometries.

        The sense of the star (t_k+1 = Rot(s, +alpha_k) t_k) is the one that has admissible
        assemblies over a right-handed base triangle.
        """
        directions = np.array(v, dtype=float)
        directions /= np.linalg.norm(directions, axis=-1)[..., None]
        following = np.roll(directions, -1, axis=-2)
        normals = np.cross(directions, following)
        sines = np.linalg.norm(normals, axis=-1)
        cosines = np.einsum("...j,...j->...", directions, following)
        angles = np.array(alpha, dtype=float)
        first, second = angles[..., 0], angles[..., 1]
        f = np.stack([np.zeros_like(first), first, first + second], axis=-1)
        e = np.stack([-np.sin(f), np.cos(f), np.zeros_like(f)], axis=-1)
        most = beta_max if np.ndim(beta_max) else float(beta_max)
        arrays = (directions, normals / sines[..., None], e, angles, np.arctan2(sines, cosines))
        frozen(*arrays)
        return cls(*arrays, most)

    @classmethod
    def of_scenarios(cls, scenarios: Any) -> tuple[Geometry, NDArray[np.intp]]:
        """Derive the distinct geometries of `Scenarios`, and the index of that of each row."""
        scene, rows = scenarios.document, [scenarios.rows.get(key) for key in _KEYS]
        varied = [values.reshape(len(values), -1) for values in rows if values is not None]
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
        """Return the geometries of rows, or of a row; this one where it is a single one."""
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
