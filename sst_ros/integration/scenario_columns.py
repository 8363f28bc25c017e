# SPDX-License-Identifier: Apache-2.0
"""Scenarios in columns: the scene with an array in place of each number that varies.

Rows in which every such number is allowed and not zero have the terms of the scene itself; they are
checked and prepared as arrays. All others (a friction of zero, an inertia that no body has,
another geometry) are left to the scenes of `scenarios`, one by one, which refuse or simplify them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import RELATIVE_ROUNDING
from sst_ros.scene.scene import LARGEST, Scene
from sst_ros.scene.schema import Section, Spec

Mask = NDArray[np.bool_]

_INERTIA = r"inertia\.(xx|yy|zz|xy|xz|yz)"
_KNOWN = re.compile(
    rf"(star|(actuated|intermediate)_links(\[\d\])?)\.({_INERTIA}|mass|centre)"
    rf"|payload\.(mass|centre|{_INERTIA})"
    r"|gravity\.acceleration|moment\.value|torque\.(amplitude|frequency|phase)"
    r"|friction\.(gamma|mu|beta)\.(viscous|coulomb|static)"
    r"|springs(\[\d+\])?\.(stiffness|rest)"
    r"|actuators\.(rotor_inertia|time_constant|torque_limit)"
)
"""Keys whose checks are those of `regular_rows`."""


def regular_rows(
    scene: Scene, columns: SimpleNamespace, rows: dict[str, Array], specs: dict[str, Spec]
) -> Mask:
    """Rows that surely make a scene with the terms of `scene`, shape (N,).

    Args:
        scene: the document.
        columns: the same with arrays, see `with_columns`.
        rows: the numbers by key, a row a scenario.
        specs: what is allowed for each key.

    """
    count = len(next(iter(rows.values())))
    if not all(_KNOWN.fullmatch(key) for key in rows):
        return np.zeros(count, dtype=bool)
    fits = np.ones(count, dtype=bool)
    for key, values in rows.items():
        spec, flat = specs[key], values.reshape(count, -1)
        allowed = (np.abs(flat) <= LARGEST) & (flat > spec.above)
        allowed &= (flat >= spec.least) & (flat <= spec.most)
        fits &= allowed.all(axis=1) & flat.any(axis=1)
    reach = max(scene.base.radius, scene.star.radius) * (1.0 - RELATIVE_ROUNDING)
    for body in (columns.star, *columns.actuated_links, *columns.intermediate_links):
        varied = any(isinstance(value, np.ndarray) for value in numbers_in(body))
        some = count if varied else 1  # what does not vary is the same in all rows
        tensor, centre = _tensor(body.inertia, some), _vector(body.centre, some)
        fits &= _is_body(tensor, body.mass, centre, reach)
    if columns.payload is not None and columns.payload.inertia is not None:
        fits &= _is_inertia(_tensor(columns.payload.inertia, count))
    for friction in vars(columns.friction).values() if columns.friction else ():
        if friction is not None:
            fits &= np.equal(friction.static, 0.0) | np.greater_equal(
                friction.static, friction.coulomb
            )
    return fits


def with_columns(section: Any, tree: dict[Any, Any], rows: dict[str, Array]) -> Any:
    """Return a section as an object with arrays (N,) for the numbers in `tree`, not checked."""
    given = dict(vars(section))
    for name, below in tree.items():
        value = given[name]
        if isinstance(below, str):
            values = rows[below]
            given[name] = values if values.ndim == 1 else tuple(values.T)
        elif isinstance(value, Section):
            given[name] = with_columns(value, below, rows)
        else:
            entries = list(value)
            for i, inside in below.items():
                entries[i] = with_columns(entries[i], inside, rows)
            given[name] = tuple(entries)
    return SimpleNamespace(**given)


def numbers_of(tree: Any, count: int) -> Array:
    """Return all numbers of a tree in order, nan for what there is not, shape (numbers, count)."""
    found = list(numbers_in(tree))
    numbers = np.empty((len(found), count))
    for row, value in zip(numbers, found, strict=True):
        row[:] = value
    return numbers


def numbers_in(value: Any) -> Iterator[Any]:
    """Yield the numbers and columns of a tree, nan for None."""
    if value is None:
        yield np.nan
    elif isinstance(value, (float, np.ndarray)):
        yield value
    elif not isinstance(value, str):
        for entry in value if isinstance(value, tuple) else vars(value).values():
            yield from numbers_in(entry)


def _is_body(inertia: Array, mass: Any, centre: Array, reach: float) -> Mask:
    """Whether inertia about O, mass and centre fit each other, well inside what a body is held to.

    Where none of them varies the document has been checked already; one row then stands for all.
    """
    fits: Mask = _is_inertia(inertia) | ~inertia.any(axis=(1, 2))
    fits &= np.linalg.norm(centre, axis=1) <= reach
    mass = np.broadcast_to(mass, len(inertia))
    fits &= (mass > 0.0) | ~centre.any(axis=1)
    squares = np.sum(centre * centre, axis=1)
    point = squares[:, None, None] * np.eye(3) - centre[:, :, None] * centre[:, None, :]
    own = np.linalg.eigvalsh(np.nan_to_num(inertia - mass[:, None, None] * point))
    scale = 0.5e-6 * np.maximum(np.abs(inertia).max(axis=(1, 2)), mass * squares)
    fits &= (own[:, 0] >= -scale) & (own[:, 2] <= own[:, 0] + own[:, 1] + scale)
    return fits


def _is_inertia(tensor: Array) -> Mask:
    finite: Mask = np.asarray(np.isfinite(tensor).all(axis=(1, 2)))
    low, middle, high = np.linalg.eigvalsh(np.where(finite[:, None, None], tensor, 0.0)).T
    most = (low + middle) * (1.0 + 0.5 * RELATIVE_ROUNDING)
    return np.asarray(finite & (low > 1e-12 * high) & (high <= most))


def _tensor(inertia: Any, count: int) -> Array:
    """Tensors, shape (N, 3, 3), or (1, 3, 3) where nothing varies."""
    if inertia is None:
        return np.zeros((count, 3, 3))
    rows = ("xx", "xy", "xz"), ("xy", "yy", "yz"), ("xz", "yz", "zz")
    parts = [np.broadcast_to(getattr(inertia, name), count) for row in rows for name in row]
    return np.stack(parts, axis=1).reshape(count, 3, 3)


def _vector(vector: Any, count: int) -> Array:
    return np.stack([np.broadcast_to(part, count) for part in vector], axis=1)
