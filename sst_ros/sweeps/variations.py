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

TINY = 2.0**-53
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
        reached = self.numbers[[0, 2, 3]] if self.kind == "normal" else self.numbers
        for target in self.targets if self.kind != "table" else ():
            numbers, spec = self.parameters(reached)[target.key], target.spec
            finite = numbers[np.isfinite(numbers)]
            if not np.all(spec.allows(finite)):
                reach = f"it reaches from {finite.min()} to {finite.max()}"
                raise ValueError(f"{spec.refuse()}; {reach}")

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of a table, one for each component."""
        shape = () if self.factor else self.targets[0].nominal.shape
        return tuple(
            self.key + "".join(f"[{i}]" for i in index) for index in np.ndindex(*shape)
        )

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
        first, last = ndtr((low - mean) / deviation), ndtr((high - mean) / deviation)
        return np.asarray(mean + deviation * ndtri(first + (last - first) * quantiles))

    def ends(self) -> Array:
        """Return a middle value, and others that differ in every component.

        All of a grid.
        """
        if not self.drawn:
            return self.numbers
        middle = self.numbers[0] if self.kind == "normal" else self.numbers.mean(axis=0)
        inner = np.repeat([[0.4], [0.6]], len(self.columns), axis=1)
        return np.vstack(
            [middle, self.values(inner) if self.kind == "normal" else self.numbers]
        )

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
            entries = (
                (entry, getattr(value, entry), of)
                for entry, of in Inertia.SPECS.items()
            )
            targets += [
                Target(f"{full_key}.{entry}", np.array(x), of)
                for entry, x, of in entries
                if x
            ]
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
    form, numbers, relative = "grid", distribution, False
    if isinstance(distribution, Mapping):
        options = dict(distribution)
        relative = options.pop("relative", False)
        form, numbers = next(iter(options.items())) if len(options) == 1 else ("", ())
    elif (
        isinstance(distribution, tuple)
        and distribution
        and isinstance(distribution[0], str)
    ):
        form, relative = (
            distribution[0],
            isinstance(distribution[-1], str) and distribution[-1] == "relative",
        )
        numbers = distribution[1 : len(distribution) - relative]
    listed = np.iterable(numbers) and not isinstance(numbers, (str, bytes, bytearray))
    if form not in VARIATION_KINDS or not isinstance(relative, bool) or not listed:
        raise ValueError(
            f"must be a list of values, or one of {', '.join(VARIATION_KINDS)} with"
            " its numbers"
        )
    factor = _scales_tensor(key, targets)
    if factor and not relative:
        raise ValueError(
            f"is a tensor: vary it with relative: true, or {key}.xx, {key}.yy, ..."
        )
    nominal = np.ones(()) if factor else targets[0].nominal
    if form == "linspace":
        count = numbers[2] if len(numbers) == 3 else 0
        if not (isinstance(count, Integral) and 0 < int(count) <= MOST_VALUES):
            raise ValueError(
                f"linspace takes low, high, count (whole, 1 to {MOST_VALUES})"
            )
        low, high = (
            np.broadcast_to(real_numbers(x), nominal.shape) for x in numbers[:2]
        )
        form, numbers = "grid", np.linspace(low, high, int(count))
    if form == "normal" and len(numbers) == 2:
        numbers = (*numbers, -np.inf, np.inf)
    expected = EXPECTED.get(form, "")
    if expected and len(numbers) != expected.count(",") + 1:
        raise ValueError(f"{form} takes {expected}")
    if form != "grid":
        numbers = [np.broadcast_to(real_numbers(x), nominal.shape) for x in numbers]
    values = np.array(real_numbers(numbers))
    if form == "grid" and (values.shape[1:] != nominal.shape or not len(values)):
        raise ValueError(f"must be a list of values of shape {nominal.shape}")
    bounded = values if form == "grid" else values[:2]
    if np.isnan(values).any() or not np.isfinite(bounded).all():
        raise ValueError("must be finite numbers")
    if form != "grid" and not np.all(values[-2] < values[-1]):
        raise ValueError("the lower end must be less than the upper one")
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


def tabulate(
    key: str, columns: Mapping[str, Array], targets: Sequence[Target]
) -> Variation:
    """Return the variation of a key by columns of a table, which must be complete."""
    if len(set(map(len, columns.values()))) > 1:
        raise ValueError("must have columns of equal length")
    values, factor = (
        np.stack(list(columns.values()), axis=1),
        _scales_tensor(key, targets),
    )
    variation = Variation(key, "table", values, targets, factor)
    if tuple(columns) != variation.columns:
        raise ValueError(f"needs the columns {', '.join(variation.columns)}")
    return variation


def read_table(source: Any) -> dict[str, Array]:
    """Read columns of numbers from a DataFrame, a mapping, or a CSV or Parquet file."""
    refused = (
        "table",
        str(source),
        "must be columns of numbers, or a .csv or .parquet file of them",
    )
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
    blocks = -(-width // 4)  # a value of the counter gives four numbers
    generator = np.random.Philox(key=seed)
    generator.advance(first * blocks)
    raw = generator.random_raw(count * 4 * blocks).reshape(count, 4 * blocks)[:, :width]
    return np.asarray(((raw >> np.uint64(11)) + 0.5) * TINY)
