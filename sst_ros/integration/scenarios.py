# SPDX-License-Identifier: Apache-2.0
"""Scenes that are one document but for some numbers: a row of each array makes a scene.

The scene of a row meets all requirements of a document. What has no effect in a row is left out of
it, as documents demand: a friction whose coefficients are zero there, the gear of a rotor without
inertia.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.host.output import slices
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import LARGEST, SMALLEST, Scene
from sst_ros.scene.schema import Place, Spec
from sst_ros.scene.yaml_document import (
    NO_NUMBER,
    broken_rows,
    build,
    find_fields,
    open_values,
    replace_values,
    values_of,
)

_MOST_PROBLEMS = 10


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
        self._values = values_of(scene)
        problems, taken = [], set[Place]()
        for key, value in parameters.items():
            try:
                for place, _, spec in find_fields(scene, key):
                    if spec.kind != "number":
                        raise ValueError(NO_NUMBER)
                    if place in taken:
                        raise ValueError("is given twice")
                    taken.add(place)
                self._specs[key] = spec
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
            return build(Scene, replace_values(self._values, values), "", of_row=True)
        except InputError as error:
            problems_of_row = [
                replace(fault, key=f"scenario {row}: {fault.key}") for fault in error.problems
            ]
            raise InputError(self.document.name, problems_of_row) from None

    def columns(self, chosen: slice | NDArray[np.intp] = slice(None)) -> Any:
        """Return the document with arrays of the chosen rows for the numbers that vary."""
        columns = {key: _components(rows[chosen]) for key, rows in self.rows.items()}
        return open_values(Scene, replace_values(self._values, columns))

    def faults(
        self, *, progress: bool = False, most: int = _MOST_PROBLEMS
    ) -> dict[int, InputError]:
        """Rows that make no scene, and why; no more than `most` rows are looked for."""
        if self.count is None:
            return {}
        unknown, faults = np.flatnonzero(self._doubtful()).tolist(), {}
        for part in slices(len(unknown), 0, f"{self.document.name}, preparing", progress):
            for row in unknown[part]:
                try:
                    self.scene(row)
                except InputError as error:
                    faults[row] = error
                if len(faults) == most:
                    return faults
        return faults

    def _doubtful(self) -> NDArray[np.bool_]:
        """Rows whose scene may be refused: a zero may refuse a number, or leave its section out."""
        doubtful = np.zeros(self.count or 0, dtype=bool)
        for key, values in self.rows.items():
            spec, flat = self._specs[key], values.reshape(len(values), -1)
            least = max(SMALLEST if spec.above == 0.0 else spec.least, -LARGEST)
            most = min(spec.most, LARGEST)
            if not (flat.min() >= least and flat.max() <= most):  # a nan is neither
                doubtful |= ~np.all((flat >= least) & (flat <= most), axis=1)
        return np.asarray(doubtful | broken_rows(Scene, self.columns()))

    def check(self, *, progress: bool = False) -> None:
        """Raise InputError with the first ten problems if rows make no scene."""
        problems = [
            problem
            for error in self.faults(progress=progress).values()
            for problem in error.problems
        ]
        if problems:
            raise InputError(self.document.name, problems[:_MOST_PROBLEMS])


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


def _components(values: Array) -> Any:
    """Contiguous columns (N,) of an array (N, ...), nested tuples where it has more dimensions."""
    if values.ndim == 1:
        return values
    return tuple(_components(np.ascontiguousarray(values[:, i])) for i in range(values.shape[1]))
