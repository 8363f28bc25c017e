# SPDX-License-Identifier: Apache-2.0
"""What varies in a study: keys of the scene, the distribution or the values of each, and the rows.

A distribution is ("uniform", low, high), ("normal", mean, standard deviation[, low, high]), or a
list of values, which spans a grid with those of other keys; in a YAML file {uniform: [low, high]},
{normal: [...]}, {grid: [...]}, {linspace: [low, high, count]}. With `relative: true` the numbers
are factors of the value in the scene. Components of a vector are independent. An inertia as a
whole ("star.inertia") has one factor, so its principal moments keep their ratios.

Row i depends on the seed and on i alone, whatever is drawn before or beside it. Random numbers come
from the counter-based generator Philox (Salmon et al., SC 2011), whose counter is the number of the
row; Sobol points from their index; a Latin hypercube from all n rows at once.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Inertia
from sst_ros.scene.schema import Section, Spec, key_of, specs
from sst_ros.scene.yaml_document import NO_NUMBER, find_fields

KINDS = ("uniform", "normal", "grid", "linspace")

SAMPLINGS = ("random", "sobol", "latin_hypercube")

LARGEST_HYPERCUBE = 10_000_000
"""Rows of a Latin hypercube: each process holds all of them, 80 bytes for ten columns."""

_TINY = 2.0**-53


@dataclass(frozen=True)
class Target:
    """A number of the scene that a variation sets: its key, value in the scene, specification."""

    key: str
    nominal: Array
    spec: Spec


@dataclass(frozen=True)
class Variation:
    """One key of a study.

    Attributes:
        key: as given.
        kind: uniform, normal, or grid.
        numbers: (low, high), (mean, standard deviation, low, high), or the values of a grid, rows
            of as many components as the key has.
        columns: names of the columns of a table of results, one for each component.
        targets: what it sets; several where one factor scales a tensor, or a key means a list.
        factor: the column is a factor of the targets' values.

    """

    key: str
    kind: str
    numbers: Array
    columns: tuple[str, ...]
    targets: tuple[Target, ...]
    factor: bool

    def values(self, quantiles: Array) -> Array:
        """Values, shape (n, components), at quantiles in (0, 1) of the same shape."""
        if self.kind == "uniform":
            low, high = self.numbers
            return np.asarray(low + (high - low) * quantiles)
        from scipy.special import ndtr, ndtri

        mean, deviation, low, high = self.numbers
        first, last = ndtr((low - mean) / deviation), ndtr((high - mean) / deviation)
        return np.asarray(mean + deviation * ndtri(first + (last - first) * quantiles))

    def parameters(self, values: Array) -> dict[str, Array]:
        """Arrays (n, ...) by key of the scene for values (n, components)."""
        found = {}
        for target in self.targets:
            rows = values * target.nominal.ravel() if self.factor else values
            found[target.key] = rows.reshape(len(values), *target.nominal.shape)
        return found


def read_variation(key: str, given: Any, targets: Sequence[Target]) -> Variation:
    """Read one entry of `vary`.

    Args:
        key: as given.
        given: distribution or values.
        targets: what the key names, see `targets_of`.

    Raises:
        ValueError: it is no distribution, or its numbers are not allowed.

    """
    kind, numbers, relative = _read(given)
    factor = scales_tensor(key, targets)
    if factor and not relative:
        raise ValueError(f"is a tensor: vary it with relative: true, or {key}.xx, {key}.yy, ...")
    shape = () if factor else targets[0].nominal.shape
    size = int(np.prod(shape, dtype=int))
    nominal = np.ones(1) if factor else targets[0].nominal.ravel()
    if kind == "linspace":
        low, high, count = numbers
        kind, numbers = "grid", np.linspace(low, high, int(count))
    if kind == "grid":
        rows = np.array(numbers, dtype=float)
        if rows.shape[1:] != shape or not len(rows) or not np.all(np.isfinite(rows)):
            raise ValueError(f"must be a list of values of shape {shape}")
        values = rows.reshape(len(rows), size)
    else:
        values = _distribution(kind, numbers, shape).reshape(-1, size)
    if relative and not factor:
        if any(not np.array_equal(one.nominal, targets[0].nominal) for one in targets):
            raise ValueError("its entries differ in the scene: give each by its index")
        values = values * nominal
        if kind == "normal":
            values[1] = np.abs(values[1])
            values[2:] = np.sort(values[2:], axis=0)
        if kind == "uniform":
            values = np.sort(values, axis=0)
    if kind == "normal" and not np.all(values[1] > 0.0):
        raise ValueError("the standard deviation must be > 0")
    _refuse_ends(kind, values, targets, factor)
    columns = tuple(f"{key}{index}" for index in _list_indices(shape))
    return Variation(key, kind, values, columns, tuple(targets), factor)


def targets_of(scene: Section, key: str) -> list[Target]:
    """Return what a key names; a list without an index means all of its entries.

    Raises:
        ValueError: it names nothing that can vary.

    """
    found = []
    for place, value, spec in find_fields(scene, key):
        here = key_of(place)
        if spec.kind == "number" and value is None:
            raise ValueError(f"the scene has no {here}")
        if isinstance(value, Inertia):
            numbers = {part: getattr(value, part) for part in specs(Inertia)}
            found += [
                Target(f"{here}.{part}", np.array(number), specs(Inertia)[part])
                for part, number in numbers.items()
                if number != 0.0
            ]
        elif spec.kind == "number":
            found.append(Target(here, np.array(value, dtype=float), spec))
        else:
            raise ValueError(f"{NO_NUMBER}, or an inertia, as star.inertia does")
    return found


def scales_tensor(key: str, targets: Sequence[Target]) -> bool:
    """Whether a key names an inertia as a whole, which one factor scales."""
    return targets[0].key.count(".") > key.count(".")


def _read(given: Any) -> tuple[str, Any, bool]:
    """Kind, numbers, and whether they are relative."""
    allowed = f"must be a list of values, or one of {', '.join(KINDS)} with its numbers"
    if isinstance(given, Mapping):
        words = dict(given)
        relative = words.pop("relative", False)
        if len(words) != 1 or next(iter(words)) not in KINDS or not isinstance(relative, bool):
            raise ValueError(allowed)
        ((kind, numbers),) = words.items()
        return kind, numbers, relative
    if isinstance(given, tuple) and given and isinstance(given[0], str):
        relative = given[-1] == "relative"
        if given[0] not in KINDS:
            raise ValueError(allowed)
        return given[0], given[1 : len(given) - relative], relative
    if isinstance(given, str) or not np.iterable(given):
        raise ValueError(allowed)
    return "grid", given, False


def _distribution(kind: str, numbers: Any, shape: tuple[int, ...]) -> Array:
    """Numbers of a distribution, broadcast to the shape of the key: (2 or 4, *shape)."""
    count = len(numbers)
    if count not in ((2,) if kind == "uniform" else (2, 4)):
        allowed = "low, high" if kind == "uniform" else "mean, standard deviation[, low, high]"
        raise ValueError(f"{kind} takes {allowed}")
    more = [] if count != 2 or kind == "uniform" else [-np.inf, np.inf]
    values = np.array([np.broadcast_to(np.array(x, dtype=float), shape) for x in (*numbers, *more)])
    if np.any(np.isnan(values)) or not np.all(np.isfinite(values[:2])):
        raise ValueError("must be finite numbers")
    ends = values if kind == "uniform" else values[2:]
    if not np.all(ends[0] < ends[1]):
        raise ValueError("the lower end must be less than the upper one")
    return values


def _refuse_ends(kind: str, values: Array, targets: Sequence[Target], factor: bool) -> None:
    """Refuse values that the specification of a target does not allow."""
    ends = values[2:] if kind == "normal" else values
    for target in targets:
        spec = target.spec
        numbers = ends * target.nominal.ravel() if factor else ends
        if kind == "normal":
            numbers = np.vstack([numbers, values[:1] * (target.nominal.ravel() if factor else 1.0)])
            numbers = numbers[np.isfinite(numbers)]
        if not np.all((numbers > spec.above) & (numbers >= spec.least) & (numbers <= spec.most)):
            raise ValueError(
                f"{spec.describe()}; it reaches from {numbers.min()} to {numbers.max()}"
            )


def _list_indices(shape: tuple[int, ...]) -> list[str]:
    return ["".join(f"[{i}]" for i in index) for index in np.ndindex(*shape)]


def keys_of(table: Mapping[str, Any]) -> dict[str, list[str]]:
    """Columns of a table by key: a trailing index is that of a component."""
    found: dict[str, list[str]] = {}
    for name in table:
        found.setdefault(re.sub(r"(\[\d+\])+$", "", name), []).append(name)
    return found


def tabulate(key: str, names: list[str], targets: list[Target], factor: bool) -> Variation:
    """Return the variation of a key whose values are columns of a table.

    Raises:
        ValueError: columns of its components are missing.

    """
    shape = () if factor else targets[0].nominal.shape
    expected = [key + "".join(f"[{i}]" for i in index) for index in np.ndindex(*shape)]
    if names != expected:
        raise ValueError(f"needs the columns {', '.join(expected)}")
    return Variation(key, "table", np.empty((0, 1)), tuple(names), tuple(targets), factor)


def read_table(path: Path) -> dict[str, Array]:
    """Read the columns of a CSV or Parquet file.

    Raises:
        InputError: it is not readable, or holds more than numbers.

    """
    pandas = require("pandas")
    try:
        frame = pandas.read_parquet(path) if path.suffix == ".parquet" else pandas.read_csv(path)
        return {str(name): frame[name].to_numpy(dtype=float) for name in frame}
    except (OSError, ValueError) as error:
        allowed = f"must be a readable .csv or .parquet file of numbers ({error})"
        raise InputError("sweep", [Problem("table", str(path), allowed)]) from None


def digest_of(values: Array) -> str:
    """Return a digest of the bits of a column."""
    return hashlib.sha256(np.ascontiguousarray(values, dtype=float).tobytes()).hexdigest()[:24]


class Sampler:
    """Values of all varied numbers by row.

    Args:
        variations: what varies.
        table: columns given row by row, in place of distributions.
        n: number of rows.
        seed: of the random numbers.
        sampling: one of SAMPLINGS, for what has a distribution.

    """

    def __init__(
        self,
        variations: Sequence[Variation],
        table: dict[str, Array],
        n: int,
        seed: int,
        sampling: str,
    ) -> None:
        self._variations, self._table = variations, table
        self._n, self._seed, self._sampling = n, seed, sampling
        self._drawn = [one for one in variations if one.kind in ("uniform", "normal")]
        self._width = sum(len(one.columns) for one in self._drawn)

    def rows(self, first: int, count: int) -> dict[str, Array]:
        """Values of rows `first` to `first + count`, shape (count, components), by key."""
        quantiles = self._quantiles(first, count)
        found, at, index = {}, 0, np.arange(first, first + count)
        grids = [one for one in self._variations if one.kind == "grid"]
        for one in reversed(grids):  # the last key varies fastest
            found[one.key] = one.numbers[index % len(one.numbers)]
            index = index // len(one.numbers)
        for one in self._drawn:
            found[one.key] = one.values(quantiles[:, at : at + len(one.columns)])
            at += len(one.columns)
        for one in self._variations:
            if one.kind == "table":
                columns = [self._table[name][first : first + count] for name in one.columns]
                found[one.key] = np.stack(columns, axis=1)
        return {one.key: found[one.key] for one in self._variations}

    def _quantiles(self, first: int, count: int) -> Array:
        """Numbers in (0, 1), shape (count, width)."""
        if not self._width:
            return np.empty((count, 0))
        if self._sampling == "random":
            return philox(self._seed, first, count, self._width)
        if self._sampling == "latin_hypercube":
            points = self._hypercube[first : first + count]
        else:
            from scipy.stats import qmc

            engine = qmc.Sobol(self._width, seed=np.random.default_rng(self._seed))
            if first:
                engine.fast_forward(first)
            points = _draw_points(engine, count)
        return np.clip(points, _TINY, 1.0 - _TINY)

    @cached_property
    def _hypercube(self) -> Array:
        from scipy.stats import qmc

        engine = qmc.LatinHypercube(self._width, seed=np.random.default_rng(self._seed))
        return np.asarray(engine.random(self._n))


def philox(seed: int, first: int, count: int, width: int) -> Array:
    """Uniform numbers in (0, 1) of rows `first` on, shape (count, width)."""
    blocks = -(-width // 4)  # a value of the counter gives four numbers
    generator = np.random.Philox(key=seed)
    generator.advance(first * blocks)
    raw = generator.random_raw(count * 4 * blocks).reshape(count, 4 * blocks)[:, :width]
    return np.asarray(((raw >> np.uint64(11)) + 0.5) * _TINY)


def _draw_points(engine: object, count: int) -> Array:
    """Sobol points without the warning that a count is no power of two: rows come in chunks."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(engine.random(count))  # type: ignore[attr-defined]
