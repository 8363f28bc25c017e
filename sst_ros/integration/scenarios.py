# SPDX-License-Identifier: Apache-2.0
"""Scenes that are one document but for some numbers: a row of each array makes a scene.

The scene of a row is held to all that documents are held to. What does nothing in a row is left out
of it, as documents demand: a friction whose coefficients are zero there, the gear of a rotor
without inertia.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.integration.scenario_columns import regular_rows, with_columns
from sst_ros.mechanism.geometry import Array
from sst_ros.progress import slices
from sst_ros.scene.bodies import Link, Payload, Star
from sst_ros.scene.scene import Actuators, Friction, Gravity, JointFriction, Scene, Spring
from sst_ros.scene.schema import Section, Spec, accept, specs

_NOTHING_WITHOUT: dict[type[Section], tuple[str, ...]] = {
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
"""A section does nothing where all of these are zero or not given."""

_ACTS_ON: dict[type[Section], dict[str, tuple[str, ...]]] = {
    Friction: {"smoothing": ("coulomb", "static"), "stribeck": ("static",)},
    Actuators: {"gear_ratio": ("rotor_inertia",)},
    Star: {"centre": ("mass",)},
    Link: {"centre": ("mass",)},
}
"""A number does nothing where all of these are zero or not given."""

_MOST_PROBLEMS = 10

Tree = dict[Any, Any]
"""Names and indices down to the keys of the numbers."""


class Variants:
    """Scenes by row.

    Args:
        scene: the document.
        parameters: numbers by their keys in the document, as in "star.mass", "springs[0].rest" or
            "gravity.acceleration": first the row, then what one scene has, so shape (N,), (N, 3) or
            (N, 3, 3). A list without an index means all of its entries.

    Attributes:
        document: the scene.
        keys: the keys.
        count: number of rows N; None where nothing varies.

    Raises:
        InputError: a key names no number of the scene, or an array has another shape.

    """

    def __init__(self, scene: Scene, parameters: Mapping[str, ArrayLike]) -> None:
        self.document = scene
        self.keys = tuple(parameters)
        self.count: int | None = None
        self._rows: dict[str, Array] = {}
        self._specs: dict[str, Spec] = {}
        self._tree: Tree = {}
        problems = []
        for key, value in parameters.items():
            try:
                spec = self._specs[key] = _entered(self._tree, scene, key.split("."), key)
                self._rows[key] = rows = _rows(value, spec, self.count)
                self.count = len(rows)
            except ValueError as error:
                problems.append(Problem(key, value, str(error)))
        if problems:
            raise InputError(scene.name, problems)

    def scene(self, row: int) -> Scene:
        """Build the scene of a row.

        Raises:
            InputError: the numbers of this row make no scene; says which and what is allowed.

        """
        values = {key: rows[row].tolist() for key, rows in self._rows.items()}
        try:
            built = _with(self.document, self._tree, values, "")
        except InputError as error:
            problems_of_row = [
                replace(fault, key=f"scenario {row}: {fault.key}") for fault in error.problems
            ]
            raise InputError(self.document.name, problems_of_row) from None
        assert isinstance(built, Scene)
        return built

    def regular(self) -> tuple[NDArray[np.intp], Any]:
        """Rows with the terms of the document that need no scene of their own, and their columns.

        The columns are the document with an array for each number that varies, see
        `scenario_columns`; they are those of all rows.
        """
        if not self._rows:
            return np.empty(0, dtype=np.intp), self.document
        with np.errstate(all="ignore"):
            columns = with_columns(self.document, self._tree, self._rows)
            mask = regular_rows(self.document, columns, self._rows, self._specs)
        rows = np.flatnonzero(mask)
        chosen = {key: values[rows] for key, values in self._rows.items()}
        return rows, with_columns(self.document, self._tree, chosen)

    def scenes(self, rows: Sequence[int], progress: bool) -> Iterator[tuple[int, Scene]]:
        """Yield the scenes of some rows, with a bar on a terminal if `progress`.

        Raises:
            InputError: rows make no scene; lists the first ten problems.

        """
        problems: list[Problem] = []
        label = f"{self.document.name}, preparing"
        for part in slices(len(rows), 0, label, progress and bool(self.keys)):
            for row in rows[part]:
                try:
                    scene = self.scene(row)
                except InputError as error:
                    problems += error.problems
                else:
                    yield row, scene
            if len(problems) >= _MOST_PROBLEMS:
                break
        if problems:
            raise InputError(self.document.name, problems[:_MOST_PROBLEMS])


def _entered(tree: Tree, section: Section, words: list[str], key: str) -> Spec:
    """Note in `tree` where in a section a key is; raises ValueError where it is no number."""
    parts = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", words[0], re.A)
    name, index = parts.groups() if parts else (words[0], None)
    known = specs(type(section))
    if name not in known:
        raise ValueError("unknown key; allowed are " + ", ".join(known))
    spec, value = known[name], getattr(section, name)
    if len(words) == 1 and spec.kind == "number" and index is None:
        if name in tree:
            raise ValueError("is given twice")
        tree[name] = key
        return spec
    if len(words) > 1 and spec.kind == "section" and index is None:
        if value is None:
            raise ValueError(f"the scene has no {name}")
        return _entered(tree.setdefault(name, {}), value, words[1:], key)
    if len(words) > 1 and spec.kind == "sections":
        chosen = range(len(value)) if index is None else [int(index)]
        if not chosen or max(chosen) >= len(value):
            raise ValueError(f"the scene has {len(value)} {name}")
        for i in chosen:
            below = tree.setdefault(name, {}).setdefault(i, {})
            spec = _entered(below, value[i], words[1:], key)
        return spec
    raise ValueError("must name a number, as star.mass does")


def _rows(value: ArrayLike, spec: Spec, count: int | None) -> Array:
    words = ", ".join(map(str, (count or "N", *spec.shape))) + ("" if spec.shape else ",")
    try:
        rows = np.array(value, dtype=float)
    except TypeError as error:
        raise ValueError(str(error)) from None
    number = count or max(1, len(np.atleast_1d(rows)))
    if rows.shape != (number, *spec.shape):
        raise ValueError(f"must have the shape ({words}), a row a scenario; it has {rows.shape}")
    return rows


def _with(section: Section, tree: Tree, values: dict[str, Any], path: str) -> Section | None:
    """Return a section with other numbers, None where it then does nothing."""
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
    needed = _NOTHING_WITHOUT.get(cls)
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
        yield Problem(name, value, spec.allowed())


def _is_some(value: Any) -> bool:
    return any(value) if isinstance(value, (list, tuple)) else bool(value)
