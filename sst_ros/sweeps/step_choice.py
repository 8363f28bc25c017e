# SPDX-License-Identifier: Apache-2.0
"""The number of steps of a study, by runs of pilot rows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.integration.batch_result import BatchResult
from sst_ros.mechanism.geometry import Array
from sst_ros.sweeps.sampling import Sampler
from sst_ros.sweeps.sweep_columns import largest_angle
from sst_ros.sweeps.sweep_study import SweepStudy

PILOT = 256
"""Rows by which the number of steps is chosen; drawn apart, so that no number of rows matters."""

MOST_STEPS = 1_000_000


def pilot_rows(study: SweepStudy) -> dict[str, Array]:
    """Return the values of what varies in the pilot rows."""
    if study.table is None:
        return Sampler(study.variations, {}, PILOT, study.seed, "random").rows(0, PILOT)
    chosen = np.linspace(0, study.rows - 1, min(PILOT, study.rows)).astype(int)
    parts = [study.sampler.rows(int(row), 1) for row in chosen]
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def chosen_steps(
    run: Callable[[int], BatchResult], unit: int, tolerance: float
) -> tuple[int, float]:
    """Least number of steps, about, whose error is within the tolerance; and that error [rad].

    The error of c steps is the difference from 2c steps; it falls with the eighth power of c.
    It is nan where no run reaches the end.

    Args:
        run: runs the pilot rows by a number of steps.
        unit: the number is a multiple of it.
        tolerance: of the orientation at the end [rad].

    Raises:
        InputError: no number of steps reaches the tolerance.

    """
    count = max(unit, 16)
    for _ in range(12):
        coarse, fine = run(count), run(2 * count)
        both = (coarse.status == 0) & (fine.status == 0)
        error = largest_angle(coarse.quaternion[both], fine.quaternion[both])
        if not both.any():
            return count, math.nan
        if error <= tolerance:
            return count, error
        factor = (error / (0.7 * tolerance)) ** (1.0 / 8.0) if math.isfinite(error) else 4.0
        count = unit * math.ceil(count * min(max(factor, 1.05), 8.0) / unit)
        if count > MOST_STEPS:
            break
    allowed = f"is not reached by {MOST_STEPS} steps; give `steps`, or a larger tolerance"
    raise InputError("sweep", [Problem("tolerance", tolerance, allowed)])
