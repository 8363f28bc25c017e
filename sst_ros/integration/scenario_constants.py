# SPDX-License-Identifier: Apache-2.0
"""The constants of a scene as a tree whose leaves are numbers, or columns of many scenarios."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics.kernel import Model, model_of
from sst_ros.dynamics.limits import limits_of
from sst_ros.dynamics.model import damping_of
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, SineTorque
from sst_ros.scene.schema import Section

Place = tuple[str | int, ...]
"""Names and indices of a leaf from the root on."""


class Constants(NamedTuple):
    """All numbers that the traced programs of a scene are made of.

    Attributes:
        model: the dynamics.
        ends: cosine and sine of the end of each limit, in the order of `limits_of`.
        torque: the scene's own torques over time; None where they do not act.

    """

    model: Model
    ends: tuple[tuple[float, float], ...]
    torque: SineTorque | None


def constants_of(scene: Scene, columns: Any, geometry: Geometry, *, profile: bool) -> Constants:
    """Constants of `columns`, which has the structure of `scene` and numbers or arrays."""
    ends = [limit.end for limit in limits_of(scene, geometry)]
    pairs = tuple((_plain(np.cos(end)), _plain(np.sin(end))) for end in ends)
    if isinstance(columns, SimpleNamespace):
        columns.stroke = _damped(columns.stroke)
    with np.errstate(invalid="ignore"):  # 0/0 is the rest of springs without stiffness
        model = model_of(columns, geometry)
    return Constants(model, pairs, columns.torque if profile else None)


def _plain(value: Any) -> Any:
    return value if value.ndim else float(value)


def _damped(stroke: Any) -> Any:
    """Elastic stops with the damping that their restitution gives, row by row if it varies."""
    varied = (stroke.restitution, stroke.impact_rate)
    if not any(isinstance(value, np.ndarray) for value in varied):
        return stroke
    pairs = zip(*np.broadcast_arrays(*varied), strict=True)
    rows = [SimpleNamespace(restitution=float(e), impact_rate=float(v)) for e, v in pairs]
    damping = np.array([damping_of(row) for row in rows])  # type: ignore[arg-type]
    return SimpleNamespace(**vars(stroke) | {"damping": damping, "restitution": None})


def leaves(value: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the place of each number or column of a tree, and what is there."""
    if isinstance(value, (float, np.ndarray)):
        yield place, value
    elif value is not None and not isinstance(value, str):
        for name, entry in _entries(value):
            yield from leaves(entry, (*place, name))


def rebuilt(value: Any, numbers: dict[Place, Any], place: Place = ()) -> Any:
    """Return a tree with other numbers; its sections are objects that are not checked."""
    if value is None:
        return None
    if isinstance(value, (float, np.ndarray)):
        return numbers[place]
    parts = [rebuilt(entry, numbers, (*place, name)) for name, entry in _entries(value)]
    if isinstance(value, tuple):
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return SimpleNamespace(**dict(zip(vars(value), parts, strict=True)))


def _entries(value: tuple[Any, ...] | Section | SimpleNamespace) -> list[tuple[Any, Any]]:
    if isinstance(value, tuple):
        return list(zip(getattr(value, "_fields", range(len(value))), value, strict=True))
    return list(vars(value).items())
