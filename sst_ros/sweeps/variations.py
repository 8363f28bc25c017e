# SPDX-License-Identifier: Apache-2.0
"""What varies in a study: keys of the scene, their distributions or values, the rows.

A distribution is ("uniform", low, high), ("normal", mean, standard deviation[, low,
high]), or a list of values, which spans a grid with those of other keys; in a YAML file
{uniform: [low, high]}, {normal: [...]}, {grid: [...]}, {linspace: [low, high, count]}.
With `relative: true` the numbers are factors of the value in the scene. Components of a
vector are independent. An inertia as a whole ("star.inertia") has one factor, so its
principal moments keep their ratios.

Row i depends on the seed and on i alone, whatever is drawn before or beside it. Random
numbers come from the counter-based generator Philox (Salmon et al., SC 2011), whose
counter is the number of the row; Sobol points from their index.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sst_ros.errors import check_regular, refuse_errors, require
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.bodies import Inertia
from sst_ros.scene.schema import Place, Section, Spec, key_of
from sst_ros.scene.yaml_document import NO_NUMBER, find_fields
from sst_ros.state import cached_property, freeze, real_numbers

VARIATION_KINDS = ("uniform", "normal", "grid", "linspace")
EXPECTED = {"uniform": "low, high", "normal": "mean, standard deviation[, low, high]"}

SAMPLINGS = ("random", "sobol")

TINY = 2.0**-53  # the least distance of a quantile from 0 and from 1
MIDDLE_QUANTILES = (0.4, 0.6)  # between which a normal distribution is tried
MOST_VALUES = 10_000_000  # of a grid


class Target(NamedTuple):
    """A number that a variation sets: key, value in the scene, specification."""

    key: str
    nominal: Array
    spec: Spec


@dataclass(frozen=True)
class Variation:
    """One key of a study.

    Attributes:
        key: as given.
        kind: uniform, normal, grid, or table.
        numbers: (low, high), (mean, standard deviation, low, high), or the values of a
            grid or of the columns of a table, rows of as many components as the key
            has.
        targets: what it sets; several where one factor scales a tensor, or a key means
            a list.
        factor: the one component is a factor of the targets' values.

    """

    key: str
    kind: str
    numbers: Array
    targets: Sequence[Target]
    factor: bool

    def __post_init__(self) -> None:
        """Raise ValueError if a value of the distribution or grid is not allowed."""
        if self.kind == "table":  # whose rows are checked as scenes
            return
        reached = self.numbers
        if self.kind == "normal":
            mean, _, low, high = self.numbers
            reached = np.array([mean, low, high])
        by_key = self.parameters(reached)
        for target in self.targets:
            numbers = by_key[target.key]
            finite = numbers[np.isfinite(numbers)]
            if not np.all(target.spec.allows(finite)):
                reach = f"it reaches from {finite.min()} to {finite.max()}"
                raise ValueError(f"{target.spec.refuse()}; {reach}")

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of a table, one for each component."""
        shape = () if self.factor else self.targets[0].nominal.shape
        names = []
        for index in np.ndindex(*shape):
            names.append(self.key + "".join(f"[{i}]" for i in index))
        return tuple(names)

    @property
    def drawn(self) -> bool:
        """Whether values are drawn from a distribution."""
        return self.kind in ("uniform", "normal")

    def values(self, quantiles: Array) -> Array:
        """Values, shape (n, components), at quantiles in (0, 1) of the same shape."""
        if self.kind == "uniform":
            low, high = self.numbers
            return np.asarray(low + (high - low) * quantiles)
        from scipy.special import ndtr, ndtri

        mean, deviation, low, high = self.numbers
        first = ndtr((low - mean) / deviation)  # quantiles of the ends
        last = ndtr((high - mean) / deviation)
        return np.asarray(mean + deviation * ndtri(first + (last - first) * quantiles))

    def ends(self) -> Array:
        """Return a middle value, then others that differ in every component.

        Of a grid they are all values.
        """
        if self.kind == "uniform":
            return np.vstack([self.numbers.mean(axis=0), self.numbers])
        if self.kind == "normal":
            quantiles = np.tile(MIDDLE_QUANTILES, (len(self.columns), 1)).T
            mean, *_ = self.numbers
            return np.vstack([mean, self.values(quantiles)])
        return self.numbers

    def parameters(self, values: Array) -> dict[str, Array]:
        """Arrays (n, ...) by key of the scene for values (n, components)."""
        by_key = {}
        for key, nominal, _ in self.targets:
            rows = values * nominal.ravel() if self.factor else values
            by_key[key] = rows.reshape(len(values), *nominal.shape)
        return by_key


def targets_of(tree: Section, key: str, place: Place = ()) -> list[Target]:
    """Return what a key names, or refuse it.

    It is one of a scene, or of settings at a place of the study.
    """
    targets = []
    for place_of_field, value, spec in find_fields(tree, key, place=place):
        full_key = key_of(place_of_field)
        if spec.kind == "number" and value is None:
            raise ValueError(f"the scene has no {full_key}")
        if isinstance(value, Inertia):
            for name, entry_spec in Inertia.SPECS.items():
                entry = getattr(value, name)
                if entry:  # a zero has no factor
                    entry_key = f"{full_key}.{name}"
                    targets.append(Target(entry_key, np.array(entry), entry_spec))
        elif spec.kind == "number":
            targets.append(Target(full_key, np.array(value, dtype=float), spec))
        else:
            raise ValueError(f"{NO_NUMBER}, or an inertia, as star.inertia does")
    return targets


def _scales_tensor(key: str, targets: Sequence[Target]) -> bool:
    """Whether a key names an inertia as a whole, which one factor scales."""
    return targets[0].key.count(".") > key.count(".")


def read_variation(key: str, distribution: Any, targets: Sequence[Target]) -> Variation:
    """Read one entry of `vary`, whose key names the targets.

    Raises ValueError where it is none.
    """
    form, numbers, relative = _read_form(distribution)
    factor = _scales_tensor(key, targets)
    if factor and not relative:
        raise ValueError(
            f"is a tensor: vary it with relative: true, or {key}.xx, {key}.yy, ..."
        )
    nominal = np.ones(()) if factor else targets[0].nominal
    if form == "linspace":
        form = "grid"
        numbers = _expand_linspace(numbers, nominal.shape)
    if form == "grid":
        values = _read_grid(numbers, nominal.shape)
    else:
        values = _read_numbers(form, numbers, nominal.shape)
    if relative and not factor:
        if any(not np.array_equal(target.nominal, nominal) for target in targets):
            raise ValueError("its entries differ in the scene: give each by its index")
        values = values * nominal
        if form == "normal":  # a negative value has mirrored it
            values[1] = np.abs(values[1])
        if form != "grid":
            values[-2:] = np.sort(values[-2:], axis=0)
    if form == "normal" and not np.all(values[1] > 0.0):
        raise ValueError("the standard deviation must be > 0")
    return Variation(key, form, values.reshape(len(values), -1), targets, factor)


def _read_form(distribution: Any) -> tuple[str, Any, bool]:
    """Return kind and numbers of an entry of `vary`, and whether it is relative."""
    form = "grid"
    numbers = distribution
    relative = False
    if isinstance(distribution, Mapping):
        options = dict(distribution)
        relative = options.pop("relative", False)
        form = ""
        if len(options) == 1:
            ((form, numbers),) = options.items()
    elif isinstance(distribution, tuple) and distribution:
        first, *others = distribution
        if isinstance(first, str):
            form = first
            last = others[-1] if others else None
            relative = isinstance(last, str) and last == "relative"
            numbers = tuple(others[:-1] if relative else others)
    listed = np.iterable(numbers) and not isinstance(numbers, (str, bytes, bytearray))
    if form not in VARIATION_KINDS or not isinstance(relative, bool) or not listed:
        raise ValueError(
            f"must be a list of values, or one of {', '.join(VARIATION_KINDS)} with"
            " its numbers"
        )
    return form, numbers, relative


def _expand_linspace(numbers: Any, shape: tuple[int, ...]) -> Array:
    """Return the values of low, high, count."""
    low, high, count = numbers if len(numbers) == 3 else (0.0, 0.0, 0)
    if not (isinstance(count, Integral) and 0 < int(count) <= MOST_VALUES):
        raise ValueError(f"linspace takes low, high, count (whole, 1 to {MOST_VALUES})")
    first = np.broadcast_to(real_numbers(low), shape)
    last = np.broadcast_to(real_numbers(high), shape)
    return np.linspace(first, last, int(count))


def _read_grid(numbers: Any, shape: tuple[int, ...]) -> Array:
    """Return values of a shape, one or more."""
    values = np.array(real_numbers(numbers))
    if values.shape[1:] != shape or not len(values):
        raise ValueError(f"must be a list of values of shape {shape}")
    if not np.isfinite(values).all():
        raise ValueError("must be finite numbers")
    return values


def _read_numbers(form: str, numbers: Any, shape: tuple[int, ...]) -> Array:
    """Return the numbers of a distribution, each of a shape, as in `Variation`."""
    if form == "normal" and len(numbers) == 2:
        numbers = (*numbers, -np.inf, np.inf)
    expected = EXPECTED[form]
    if len(numbers) != expected.count(",") + 1:
        raise ValueError(f"{form} takes {expected}")
    components = [np.broadcast_to(real_numbers(number), shape) for number in numbers]
    values = np.array(real_numbers(components))
    # Ends of a normal distribution may be infinite.
    if np.isnan(values).any() or not np.isfinite(values[:2]).all():
        raise ValueError("must be finite numbers")
    *_, low, high = values
    if not np.all(low < high):
        raise ValueError("the lower end must be less than the upper one")
    return values


def tabulate(
    key: str, columns: Mapping[str, Array], targets: Sequence[Target]
) -> Variation:
    """Return the variation of a key by columns of a table, which must be complete."""
    if len(set(map(len, columns.values()))) > 1:
        raise ValueError("must have columns of equal length")
    values = np.stack(list(columns.values()), axis=1)
    factor = _scales_tensor(key, targets)
    variation = Variation(key, "table", values, targets, factor)
    if tuple(columns) != variation.columns:
        raise ValueError(f"needs the columns {', '.join(variation.columns)}")
    return variation


def read_table(source: Any) -> dict[str, Array]:
    """Read columns of numbers from a DataFrame, a mapping, or a CSV or Parquet file."""
    requirement = "must be columns of numbers, or a .csv or .parquet file of them"
    refused = "table", str(source), requirement
    with refuse_errors("sweep", *refused, OSError, ValueError, TypeError, LookupError):
        if isinstance(source, Path):
            check_regular(source)
            form = "parquet" if source.suffix == ".parquet" else "csv"
            source = getattr(require("pandas"), f"read_{form}")(source)
        columns = {str(name): freeze(real_numbers(source[name])) for name in source}
        if not columns or not all(map(np.size, columns.values())):
            raise ValueError("it is empty")
        if all(column.ndim == 1 for column in columns.values()):
            return columns
        raise ValueError("a column has one number for each row")


def philox(seed: int, first: int, count: int, width: int) -> Array:
    """Uniform numbers in (0, 1) of rows `first` on, shape (count, width)."""
    # A value of the counter gives four numbers; the last of them may have no column.
    blocks = -(-width // 4)
    generator = np.random.Philox(key=seed)
    generator.advance(first * blocks)
    raw = generator.random_raw(count * 4 * blocks).reshape(count, 4 * blocks)[:, :width]
    return np.asarray(((raw >> np.uint64(11)) + 0.5) * TINY)
