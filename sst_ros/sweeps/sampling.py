# SPDX-License-Identifier: Apache-2.0
"""Rows of a study: row i depends on the seed and on i alone, whatever is drawn before or beside it.

Random numbers come from the counter-based generator Philox (Salmon et al., SC 2011), whose counter
is the number of the row; Sobol points from their index; a Latin hypercube from all n rows at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.variations import Variation

SAMPLINGS = ("random", "sobol", "latin_hypercube")
LARGEST_HYPERCUBE = 10_000_000
"""Rows of a Latin hypercube: each process holds all of them, 80 bytes for ten columns."""

_TINY = 2.0**-53


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
            points = _drawn(engine, count)
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


def _drawn(engine: object, count: int) -> Array:
    """Sobol points without the warning that a count is no power of two: rows come in chunks."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(engine.random(count))  # type: ignore[attr-defined]
