# SPDX-License-Identifier: Apache-2.0
"""Scenarios as columns: the scene with an array in place of each number that varies.

`valid_rows` checks the columns with array operations. It is sufficient, not necessary: a row that
it does not accept is built as a `Scene`, which accepts it or names the fault.
"""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.integration.scenario_constants import leaves
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import RELATIVE_ROUNDING, SMALLEST_MOMENT
from sst_ros.scene.scene import LARGEST, SMALLEST, Scene
from sst_ros.scene.schema import Section, Spec

Mask = NDArray[np.bool_]

_INERTIA = r"inertia\.(xx|yy|zz|xy|xz|yz)"
_CHECKED = re.compile(
    rf"(star|(actuated|intermediate)_links(\[\d\])?)\.({_INERTIA}|mass|centre)"
    rf"|payload\.(mass|centre|{_INERTIA})"
    r"|gravity\.acceleration|moment\.value|torque\.(amplitude|frequency|phase)"
    r"|friction\.(gamma|mu|beta)\.(viscous|coulomb|static|smoothing|stribeck)"
    r"|springs(\[\d+\])?\.(stiffness|rest)|stroke\.(stiffness|damping)"
    r"|base\.v|star\.alpha_deg|workspace\.beta_max_deg"
    r"|actuators\.(rotor_inertia|gear_ratio|time_constant|torque_limit|idle_damping)"
)
"""Keys whose checks across fields are those of `valid_rows`."""


def valid_rows(
    scene: Scene, columns: Any, rows: dict[str, Array], specs: dict[str, Spec], count: int
) -> Mask:
    """Rows that certainly make a scene, shape (count,).

    Args:
        scene: the document.
        columns: the same with arrays, see `with_columns`.
        rows: the numbers by key, a row a scenario.
        specs: what is allowed for each key.
        count: number of rows.

    """
    restituted = scene.stroke.restitution is not None
    if not all(_CHECKED.fullmatch(key) for key in rows) or (
        restituted and "stroke.damping" in rows
    ):
        return np.zeros(count, dtype=bool)
    valid = np.ones(count, dtype=bool)
    for key, values in rows.items():
        spec = specs[key]
        least = max(SMALLEST if spec.above == 0.0 else spec.least, -LARGEST)
        most = min(spec.most, LARGEST)
        if not (values.min() >= least and values.max() <= most):  # a nan is neither
            flat = values.reshape(count, -1)
            valid &= np.all((flat >= least) & (flat <= most), axis=1)
    if "base.v" in rows:
        valid &= _is_base(rows["base.v"])
    if "star.alpha_deg" in rows:
        total = np.sum(rows["star.alpha_deg"], axis=1)
        valid &= np.abs(total - 360.0) < 359.0 * RELATIVE_ROUNDING
    reach = max(scene.base.radius, scene.star.radius) * (1.0 - RELATIVE_ROUNDING)
    mass: Any = 0.0
    for body in (columns.star, *columns.actuated_links, *columns.intermediate_links):
        mass = mass + body.mass
        if any(isinstance(value, np.ndarray) for _, value in leaves(body)):
            valid &= _is_body(body, reach)
    if columns.payload is not None:
        mass = mass + columns.payload.mass
        if columns.payload.inertia is not None:
            valid &= _is_inertia(_tensor(columns.payload.inertia))
    if columns.gravity is not None:
        valid &= np.greater(mass, 0.0)
    for friction in vars(columns.friction).values() if columns.friction else ():
        if friction is not None:
            none, enough = friction.static == 0.0, friction.static >= friction.coulomb
            valid &= np.logical_or(none, enough)
    return valid


def with_columns(section: Any, tree: dict[Any, Any], rows: dict[str, Array]) -> Any:
    """Return a section as an object with arrays (N,) for the numbers in `tree`, not checked."""
    given = dict(vars(section))
    for name, below in tree.items():
        value = given[name]
        if isinstance(below, str):
            given[name] = _components(rows[below])
        elif isinstance(value, Section):
            given[name] = with_columns(value, below, rows)
        else:
            entries = list(value)
            for i, inside in below.items():
                entries[i] = with_columns(entries[i], inside, rows)
            given[name] = tuple(entries)
    return SimpleNamespace(**given)


def _components(values: Array) -> Any:
    """Contiguous columns (N,) of an array (N, ...), nested tuples where it has more dimensions."""
    if values.ndim == 1:
        return values
    return tuple(_components(np.ascontiguousarray(values[:, i])) for i in range(values.shape[1]))


def _is_base(v: Array) -> Mask:
    """Whether directions are three corners of a right-handed triangle that is not degenerate."""
    lengths = np.linalg.norm(v, axis=-1)
    unit = v / lengths[..., None]
    volume = np.sum(unit[:, 0] * np.cross(unit[:, 1], unit[:, 2]), axis=-1)
    return np.asarray((lengths.min(axis=1) > 1.1e-6) & (volume > 2.0 * RELATIVE_ROUNDING))


def _is_body(body: Any, reach: float) -> Mask:
    """Whether inertia about O, mass and centre fit each other.

    A tensor is that of a body if its second moments tr(I)/2 - I are positive semidefinite; about
    the centre of mass c they are less by m c c^T. Without mass a centre is of no effect.
    """
    x, y, z = body.centre
    mass = body.mass
    valid: Mask = np.asarray((x * x + y * y + z * z <= reach * reach) | np.equal(mass, 0.0))
    if body.inertia is None:
        # A point with mass is refused in the scene, too; without mass there is nothing to check.
        return np.asarray(valid & np.equal(mass, 0.0))
    xx, yy, zz, xy, xz, yz = _tensor(body.inertia)
    about_o = _is_inertia((xx, yy, zz, xy, xz, yz))
    massless = np.equal(mass, 0.0)
    if massless.all():
        return np.asarray(valid & about_o)
    trace = xx + yy + zz
    scale = 0.1e-6 * trace
    moments = (
        0.5 * trace - xx - mass * x * x + scale,
        0.5 * trace - yy - mass * y * y + scale,
        0.5 * trace - zz - mass * z * z + scale,
        -xy - mass * x * y, -xz - mass * x * z, -yz - mass * y * z,
    )  # fmt: skip
    return np.asarray(valid & about_o & (massless | _is_positive(*moments)))


def _is_inertia(tensor: tuple[Any, ...]) -> Mask:
    """Whether a tensor is positive definite with principal moments that a body can have."""
    xx, yy, zz, xy, xz, yz = tensor
    trace = xx + yy + zz
    least = SMALLEST_MOMENT + 1e-12 * trace
    half = (0.5 + 0.1 * RELATIVE_ROUNDING) * trace
    definite = _is_positive(xx - least, yy - least, zz - least, xy, xz, yz)
    other = _is_positive(half - xx, half - yy, half - zz, -xy, -xz, -yz)
    return np.asarray(definite & other)


def _is_positive(xx: Any, yy: Any, zz: Any, xy: Any, xz: Any, yz: Any) -> Mask:
    """Whether a symmetric matrix is positive definite: the pivots of its L D L^T are positive."""
    if not any(isinstance(x, np.ndarray) or x != 0.0 for x in (xy, xz, yz)):
        return np.asarray((xx > 0.0) & (yy > 0.0) & (zz > 0.0))
    second = yy - xy * xy / xx
    off = yz - xy * xz / xx
    third = zz - xz * xz / xx - off * off / second
    return np.asarray((xx > 0.0) & (second > 0.0) & (third > 0.0))


def _tensor(inertia: Any) -> tuple[Any, ...]:
    return inertia.xx, inertia.yy, inertia.zz, inertia.xy, inertia.xz, inertia.yz
