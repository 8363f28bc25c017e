# SPDX-License-Identifier: Apache-2.0
"""Scenes that are one document but for some numbers: a row of each array makes a scene.

The scene of a row meets all requirements of a document. What has no effect in a row is left out of
it, as documents demand: a friction whose coefficients are zero there, the gear of a rotor without
inertia.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.host.output import slices
from sst_ros.integration.scenario_columns import valid_rows, with_columns
from sst_ros.integration.scenario_constants import Place
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Link, Payload, Star
from sst_ros.scene.scene import Actuators, Friction, Gravity, JointFriction, Scene, Spring
from sst_ros.scene.schema import Section, Spec, accept, specs

_NEEDS: dict[type[Section], tuple[str, ...]] = {
    Gravity: ("acceleration",),
    Friction: ("viscous", "coulomb", "static"),
    JointFriction: ("gamma", "mu", "beta"),
    Spring: ("stiffness",),
    Payload: ("mass", "inertia"),
    Actuators: (
        "rotor_inertia", "torque_limit", "time_constant", "idle_damping", "velocity_limit",
        "acceleration_limit",
    ),
}  # fmt: skip
"""A section has no effect where all of these are zero or not given."""

_ACTS_ON: dict[type[Section], dict[str, tuple[str, ...]]] = {
    Friction: {"smoothing": ("coulomb", "static"), "stribeck": ("static",)},
    Actuators: {"gear_ratio": ("rotor_inertia",)},
    Star: {"centre": ("mass",)},
    Link: {"centre": ("mass",)},
}
"""A number has no effect where all of these are zero or not given."""

_MOST_PROBLEMS = 10

NO_NUMBER = "must name a number, as star.mass does"

Tree = dict[Any, Any]
"""Names and indices down to the keys of the numbers."""


class Scenarios:
    """Scenarios of a scene by row.

    Args:
        scene: the document.
        parameters: numbers by their keys in the document, as in "star.mass", "springs[0].rest" or
            "gravity.acceleration": first the row, then what one scene has, so shape (N,), (N, 3) or
            (N, 3, 3). A list without an index means all of its entries.

    Attributes:
        document: the scene.
        rows: the arrays by key.
        count: number of rows N; None where nothing varies.

    Raises:
        InputError: a key names no number of the scene, or an array has another shape.

    """

    def __init__(self, scene: Scene, parameters: Mapping[str, ArrayLike]) -> None:
        self.document = scene
        self.count: int | None = None
        self.rows: dict[str, Array] = {}
        self._specs: dict[str, Spec] = {}
        self._tree: Tree = {}
        problems = []
        for key, value in parameters.items():
            try:
                spec = self._specs[key] = _entered(self._tree, scene, key)
                self.rows[key] = rows = _rows(value, spec, self.count)
                self.count = len(rows)
            except ValueError as error:
                problems.append(Problem(key, value, str(error)))
        if problems:
            raise InputError(scene.name, problems)

    def scene(self, row: int) -> Scene:
        """Build the scene of a row.

        Raises:
            InputError: the numbers of this row make no scene; names each and what is allowed.

        """
        values = {key: rows[row].tolist() for key, rows in self.rows.items()}
        try:
            built = _with(self.document, self._tree, values, "")
        except InputError as error:
            problems_of_row = [
                replace(fault, key=f"scenario {row}: {fault.key}") for fault in error.problems
            ]
            raise InputError(self.document.name, problems_of_row) from None
        assert isinstance(built, Scene)
        return built

    def columns(self, chosen: slice | NDArray[np.intp] = slice(None)) -> Any:
        """Return the document with arrays of the chosen rows for the numbers that vary."""
        rows = {key: values[chosen] for key, values in self.rows.items()}
        return with_columns(self.document, self._tree, rows)

    def faults(
        self, *, progress: bool = False, most: int = _MOST_PROBLEMS
    ) -> dict[int, InputError]:
        """Rows that make no scene, and why; no more than `most` rows are looked for."""
        if self.count is None:
            return {}
        with np.errstate(all="ignore"):
            valid = valid_rows(self.document, self.columns(), self.rows, self._specs, self.count)
        unknown, faults = np.flatnonzero(~valid).tolist(), {}
        for part in slices(len(unknown), 0, f"{self.document.name}, preparing", progress):
            for row in unknown[part]:
                try:
                    self.scene(row)
                except InputError as error:
                    faults[row] = error
                if len(faults) == most:
                    return faults
        return faults

    def check(self, *, progress: bool = False) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        problems = [
            problem
            for error in self.faults(progress=progress).values()
            for problem in error.problems
        ]
        if problems:
            raise InputError(self.document.name, problems[:_MOST_PROBLEMS])


def addressed(
    section: Section, words: list[str], place: Place = ()
) -> Iterator[tuple[Place, Any, Spec]]:
    """Yield the place of each field that the words of a key name, its value, and what it allows.

    A list without an index means all of its entries.

    Raises:
        ValueError: there is no such field, or it is not in this scene.

    """
    parts = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", words[0], re.A)
    name, index = parts.groups() if parts else (words[0], None)
    known = specs(type(section))
    if name not in known:
        raise ValueError("unknown key; allowed are " + ", ".join(known))
    spec, value, here = known[name], getattr(section, name), (*place, name)
    if len(words) == 1 and index is None:
        yield here, value, spec
    elif len(words) > 1 and spec.kind == "section" and index is None:
        if value is None:
            raise ValueError(f"the scene has no {name}")
        yield from addressed(value, words[1:], here)
    elif len(words) > 1 and spec.kind == "sections":
        chosen = range(len(value)) if index is None else [int(index)]
        if not chosen or max(chosen) >= len(value):
            raise ValueError(f"the scene has {len(value)} {name}")
        for i in chosen:
            yield from addressed(value[i], words[1:], (*here, i))
    else:
        raise ValueError(NO_NUMBER)


def _entered(tree: Tree, scene: Scene, key: str) -> Spec:
    """Note in `tree` where in a scene a key is; raises ValueError where it is no number."""
    for place, _, spec in addressed(scene, key.split(".")):
        if spec.kind != "number":
            raise ValueError(NO_NUMBER)
        below = tree
        for part in place[:-1]:
            below = below.setdefault(part, {})
        if place[-1] in below:
            raise ValueError("is given twice")
        below[place[-1]] = key
    return spec


def _rows(value: ArrayLike, spec: Spec, count: int | None) -> Array:
    words = ", ".join(map(str, (count or "N", *spec.shape))) + ("" if spec.shape else ",")
    try:
        rows = np.asarray(value, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from None
    number = count or max(1, len(np.atleast_1d(rows)))
    if rows.shape != (number, *spec.shape):
        raise ValueError(f"must have the shape ({words}), a row a scenario; it has {rows.shape}")
    return rows


def _with(section: Section, tree: Tree, values: dict[str, Any], path: str) -> Section | None:
    """Return a section with other numbers, None where it then has no effect."""
    cls, given = type(section), dict(vars(section))
    problems: list[Problem] = []
    for name, below in tree.items():
        here = f"{path}.{name}" if path else name
        if isinstance(below, str):
            given[name] = values[below]
            problems += _faults(specs(cls)[name], name, values[below])
        elif isinstance(given[name], Section):
            given[name] = _with(given[name], below, values, here)
        else:
            entries = list(given[name])
            for i, inside in below.items():
                entries[i] = _with(entries[i], inside, values, f"{here}[{i}]")
            given[name] = tuple(entry for entry in entries if entry is not None)
    for name, causes in _ACTS_ON.get(cls, {}).items():
        if not any(_is_some(given[cause]) for cause in causes):
            given[name] = cls.__dataclass_fields__[name].default
    needed = _NEEDS.get(cls)
    try:
        if problems:
            raise InputError("", problems)
        if needed and not any(_is_some(given[name]) for name in needed):
            return None
        return cls(**given)
    except InputError as error:
        problems_of_row = [
            replace(fault, key=".".join(filter(None, [path, fault.key])))
            for fault in error.problems
        ]
        raise InputError("", problems_of_row) from None


def _faults(spec: Spec, name: str, value: Any) -> Iterator[Problem]:
    """Refuse what a field may not hold; zero is checked by the section, or leaves it out."""
    try:
        if _is_some(value):
            accept(spec, value)
    except ValueError:
        yield Problem(name, value, spec.describe())


def _is_some(value: Any) -> bool:
    return any(value) if isinstance(value, (list, tuple)) else bool(value)
