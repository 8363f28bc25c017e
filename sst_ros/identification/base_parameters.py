# SPDX-License-Identifier: Apache-2.0
"""Base parameters: the combinations of parameters that torques depend on, and no others.

A QR decomposition of the regressor shows which columns are combinations of earlier ones (Gautier,
J. Robotic Systems 8 (1991) 485-506). With random states it does so for the mechanism; with the
states of a motion it shows what that motion leaves undetermined as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sst_ros.identification.regressor import Regressor
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry

DEPENDENT = 1e-8
"""Distance of a column from the span of those before it, over its own length, below which it counts
as one of them: between rounding (1e-13) and the least of any mechanism tried (1e-4)."""

NEGLIGIBLE = 1e-10
"""Share of a column's length that is rounding."""

_STATES = 300


@dataclass(frozen=True)
class BaseParameters:
    """Combinations of parameters: beta = transform parameters.

    Attributes:
        names: of the parameters, length p.
        chosen: the parameters whose columns are independent, length b.
        transform: shape (b, p); row i has 1 at the chosen parameter i, and the coefficients of
            those whose columns depend on it.

    """

    names: tuple[str, ...]
    chosen: tuple[int, ...]
    transform: Array

    def of_columns(self, columns: Array) -> Array:
        """Pick the regressor of the base parameters out of that of all, shape (..., p)."""
        return columns[..., list(self.chosen)]

    @property
    def labels(self) -> tuple[str, ...]:
        """Each combination as text."""
        rows = zip(self.transform, self.chosen, strict=True)
        return tuple(_text(row, self.names, i) for row, i in rows)


def structural(regressor: Regressor, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the mechanism: those that some motion determines."""
    return independent(regressor(*_states(Geometry.of(regressor.scene), seed))[1], regressor.names)


def independent(columns: Array, names: Sequence[str]) -> BaseParameters:
    """Return the base parameters of a regressor, shape (n, 3, p)."""
    matrix = _upper(columns.reshape(-1, columns.shape[-1]))
    lengths = np.linalg.norm(matrix, axis=0)
    there = np.flatnonzero(lengths > NEGLIGIBLE * lengths.max(initial=1e-300))
    scaled = matrix[:, there] / lengths[there]
    chosen: list[int] = []
    for i in range(len(there)):
        trial = [*chosen, i]
        # The last diagonal entry of R is the distance from the span of the columns before.
        if abs(_upper(scaled[:, trial])[-1, -1]) > DEPENDENT:
            chosen = trial
    solved = np.linalg.lstsq(scaled[:, chosen], scaled, rcond=None)[0]
    solved[np.abs(solved) < NEGLIGIBLE] = 0.0
    transform = np.zeros((len(chosen), len(names)))
    transform[:, there] = solved * lengths[there] / lengths[there[chosen]][:, None]
    return BaseParameters(tuple(names), tuple(there[chosen].tolist()), transform)


def _upper(matrix: Array) -> Array:
    """R of a QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _states(geometry: Geometry, seed: int) -> tuple[Array, Array, Array]:
    """Random admissible poses within the stroke, rates and accelerations."""
    rng = np.random.default_rng(seed)
    found = kinematics.direct_many(geometry, rng.uniform(0.1, 0.9, (_STATES, 3)) * geometry.arc)
    regular = found.admissible & (np.abs(found.det_j2) > 0.05) & np.all(np.sin(found.mu) > 0.1, 1)
    quaternion = quaternion_of(found.rotation[regular])
    rate, acceleration = rng.normal(size=(2, len(quaternion), 3)) * [[[2.0]], [[20.0]]]
    return quaternion, rate, acceleration


def _text(row: Array, names: Sequence[str], chosen: int) -> str:
    """Write a combination; the chosen parameter comes first."""
    others = [i for i in np.flatnonzero(row).tolist() if i != chosen]
    parts = (
        f" {'-' if row[i] < 0.0 else '+'} "
        + (f"{abs(row[i]):.4g} " if abs(abs(row[i]) - 1.0) > NEGLIGIBLE else "")
        + names[i]
        for i in others
    )
    return names[chosen] + "".join(parts)
