# SPDX-License-Identifier: Apache-2.0
"""Columns of a table of results: components, extremes, units, rows that make no scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError
from sst_ros.integration.batch_result import BatchStates
from sst_ros.mechanism.geometry import Array
from sst_ros.state import DIMENSIONS, QUANTITIES
from sst_ros.sweeps.variations import Variation

Columns = dict[str, NDArray[Any]]

_JOINTS = ("gamma", "mu", "beta", "gamma_dot", "mu_dot", "beta_dot")


def units_of(variations: Sequence[Variation]) -> dict[str, str]:
    """Return the unit of each column that has one."""
    found = {"t": "s", "fault_time": "s", "energy": "J", "local_error": "1"}
    for name, (unit, dimension) in QUANTITIES.items():
        for part in DIMENSIONS[dimension]:
            for suffix in ("", "_min", "_max"):
                found[f"{name}{suffix}_{part}"] = unit
    for part in DIMENSIONS["leg"]:
        found |= {f"error_rms_{part}": "rad", f"error_max_{part}": "rad"}
    for one in variations:
        unit = "1" if one.factor else one.targets[0].spec.unit
        found |= dict.fromkeys(one.columns, unit)
    return found


def components(name: str, array: Array) -> Columns:
    """Return a column for each component of a quantity, shape (n, components)."""
    _, dimension = QUANTITIES[name]
    return {
        f"{name}_{part}": np.ascontiguousarray(array[:, i])
        for i, part in enumerate(DIMENSIONS[dimension])
    }


def extremes_of(kept: BatchStates) -> Columns:
    """Least and largest angles and rates of joints at the ends of steps."""
    found: Columns = {}
    with np.errstate(all="ignore"):
        for name in _JOINTS:
            array = getattr(kept, name)
            for suffix, reduced in (("min", array.min(axis=0)), ("max", array.max(axis=0))):
                for k in range(3):
                    found[f"{name}_{suffix}_{k + 1}"] = reduced[:, k]
    return found


def with_faults(
    columns: Columns, texts: NDArray[Any], reason: NDArray[Any], faults: dict[int, InputError]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Mark rows that make no scene: status -1, no numbers, and the first problem as the reason."""
    rows, reason = list(faults), reason.copy()
    for name, array in columns.items():
        columns[name] = array.copy()
        columns[name][rows] = -1 if name == "status" else np.nan
    columns["fault_time"][rows] = 0.0
    found = [f"no scene: {error.problems[0].key.partition(': ')[2]}" for error in faults.values()]
    distinct = sorted(set(found))
    reason[rows] = [len(texts) + distinct.index(text) for text in found]
    return np.array([*texts, *distinct], dtype=object), reason


def largest_angle(one: Array, other: Array) -> float:
    """Largest angle between orientations [rad]."""
    if not len(one):
        return 0.0
    apart = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return float(2.0 * apart.max())
