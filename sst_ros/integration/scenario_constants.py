# SPDX-License-Identifier: Apache-2.0
"""The constants of a scene as a tree of numbers, and a table of those of many scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics.kernel import Model, model_of
from sst_ros.dynamics.limits import limits_of
from sst_ros.integration.scenario_columns import numbers_in, numbers_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene, SineTorque
from sst_ros.scene.schema import Section

_NO_COEFFICIENTS = ("smoothing", "stribeck", "rest")
"""Divisors and offsets: any will do where the coefficient is zero."""

Place = tuple[str | int, ...]
Places = tuple[Place, ...]


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


class Member(NamedTuple):
    """What a batch knows of one scene.

    Attributes:
        constants: its constants.
        numbers: the same in order, nan for what there is not, shape (n,).
        geometry: base triangle and star.
        torque_limit: largest torque of an actuator [N m], infinite without one.

    """

    constants: Constants
    numbers: Array
    geometry: Geometry
    torque_limit: float

    @property
    def shape(self) -> bytes:
        """Bytes that are the same for the same geometry."""
        geometry = self.geometry
        ends = np.array(geometry.beta_max).tobytes()
        return geometry.v.tobytes() + geometry.alpha.tobytes() + ends


def member_of(scene: Scene, *, profile: bool) -> Member:
    """Collect what a batch needs of a scene, its own torques over time if they act."""
    geometry = Geometry.of(scene)
    constants = constants_of(scene, scene, geometry, profile=profile)
    limit = scene.actuators.torque_limit if scene.actuators else None
    numbers = numbers_of(constants, 1)[:, 0]
    return Member(constants, numbers, geometry, math.inf if limit is None else limit)


def constants_of(scene: Scene, columns: Any, geometry: Geometry, *, profile: bool) -> Constants:
    """Constants of `columns`, which has the structure of `scene` and numbers or arrays."""
    ends = [limit.end for limit in limits_of(scene, geometry)]
    pairs = tuple(zip(np.cos(ends).tolist(), np.sin(ends).tolist(), strict=True))
    return Constants(model_of(columns, geometry), pairs, columns.torque if profile else None)


def joined(one: Any, other: Any) -> Any:
    """Return a tree with the parts of two."""
    if one is None or other is None:
        return other if one is None else one
    if isinstance(one, tuple):
        return _like(one, [joined(*both) for both in zip(one, other, strict=True)])
    return one


def rebuilt(value: Any, numbers: dict[Place, Any], place: Place = ()) -> Any:
    """Return a tree with other numbers."""
    if isinstance(value, (tuple, Section)):
        parts = [rebuilt(entry, numbers, (*place, name)) for name, entry in _entries(value)]
        return _like(value, parts)
    return None if value is None else numbers[place]


def alike(constants: Constants, columns: Constants) -> tuple[Places, list[Any]]:
    """Return what `table` does for scenes that have the same terms, a number where all have it."""
    places = tuple(_places(constants, ()))
    numbers = [x for x in numbers_in(columns) if isinstance(x, np.ndarray) or not math.isnan(x)]
    return places, numbers


def table(
    kinds: Sequence[tuple[Constants, NDArray[np.intp], Array]],
) -> tuple[Places, Array]:
    """All places there are, and the numbers there, a column a scene.

    A scene that lacks a term gets coefficients of zero.

    Args:
        kinds: for each set of terms the constants of a scene that has it, the rows of all such
            scenes, shape (m,), and a column of `Member.numbers` for each.

    """
    own = [tuple(_places(constants, ())) for constants, _, _ in kinds]
    places = tuple(dict.fromkeys(place for some in own for place in some))
    line = {place: i for i, place in enumerate(places)}
    found = np.full((len(places), sum(len(rows) for _, rows, _ in kinds)), np.nan)
    for some, (_, rows, values) in zip(own, kinds, strict=True):
        lines = np.array([line[place] for place in some])
        found[np.ix_(lines, rows)] = values[~np.isnan(values[:, 0])]
    for place, numbers in zip(places, found, strict=True):
        missing = np.isnan(numbers)
        if missing.any():
            numbers[missing] = numbers[~missing][0] if place[-1] in _NO_COEFFICIENTS else 0.0
    for place, numbers in zip(places, found, strict=True):
        if place[-1] == "static" and numbers.any():
            # static = 0 is no breakaway torque, which is as if it were the Coulomb torque.
            coulomb = (*place[:-1], "coulomb")
            numbers[:] = np.where(numbers == 0.0, found[line[coulomb]], numbers)
    return places, found


def _places(value: Any, place: Place) -> Iterator[Place]:
    """Places of the numbers in the same order."""
    if isinstance(value, (tuple, Section)):
        for name, entry in _entries(value):
            yield from _places(entry, (*place, name))
    elif value is not None:
        yield place


def _entries(value: tuple[Any, ...] | Section) -> list[tuple[Any, Any]]:
    if isinstance(value, Section):
        return list(vars(value).items())
    return list(zip(getattr(value, "_fields", range(len(value))), value, strict=True))


def _like(value: tuple[Any, ...] | Section, entries: list[Any]) -> Any:
    """Return what has other entries; a section as an object that is not checked."""
    if isinstance(value, Section):
        return SimpleNamespace(**dict(zip(vars(value), entries, strict=True)))
    return type(value)(*entries) if hasattr(value, "_fields") else tuple(entries)
