# SPDX-License-Identifier: Apache-2.0
"""Rows of a study by which its ranges are checked, and by which is found what differs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.sweeps.variations import Variation


def range_ends(study: SweepStudy) -> dict[str, Array]:
    """Return rows at the middle and at the ends of all ranges, by key of the scene."""
    rows = []
    tabulated = [one for one in study.variations if one.kind == "table"]
    middle = {one.key: _middle(one) for one in study.variations if one.kind != "table"}
    picks = {0}
    for values in (study.table or {}).values():
        picks |= {int(np.argmin(values)), int(np.argmax(values))}
    for pick in sorted(picks) if tabulated else []:
        row = study.sampler.rows(pick, 1)
        rows.append(middle | {one.key: row[one.key][0] for one in tabulated})
    rows = rows or [middle]
    for one in study.variations:
        rows += [rows[0] | {one.key: end} for end in _ends(one)]
    stacked = {one.key: np.stack([row[one.key] for row in rows]) for one in study.variations}
    return parameters_of(study, stacked)


def parameters_of(study: SweepStudy, values: Mapping[str, Array]) -> dict[str, Array]:
    """Return arrays by key of the scene for the values of what varies."""
    found: dict[str, Array] = {}
    for one in study.variations:
        found |= one.parameters(values[one.key])
    return found


def _middle(one: Variation) -> Array:
    return np.asarray(one.numbers.mean(axis=0) if one.kind == "uniform" else one.numbers[0])


def _ends(one: Variation) -> list[Array]:
    """Values that differ in every component that can differ."""
    if one.kind == "normal":
        return [one.values(np.full((1, len(one.columns)), q))[0] for q in (0.4, 0.6)]
    return list(one.numbers)
