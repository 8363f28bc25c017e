# SPDX-License-Identifier: Apache-2.0
"""Rows of a study given as a table: a column for each number of the scene that varies."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.variations import Target, Variation


def keys_of(table: Mapping[str, Any]) -> dict[str, list[str]]:
    """Columns of a table by key: a trailing index is that of a component."""
    found: dict[str, list[str]] = {}
    for name in table:
        found.setdefault(re.sub(r"(\[\d+\])+$", "", name), []).append(name)
    return found


def tabulated(key: str, names: list[str], targets: list[Target], factor: bool) -> Variation:
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
