# SPDX-License-Identifier: Apache-2.0
"""One step of an explicit Runge-Kutta method, with its local error estimate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.integration.methods import Tableau

Vector = tuple[float, ...]
Derivative = Callable[[float, Vector], Sequence[float]]


class Step(NamedTuple):
    """Result of a step; `error` is the norm of its local error estimate, nan where none exists."""

    y: Vector
    error: float


class ExplicitMethod:
    """A Runge-Kutta method whose stages are combined by NumPy and evaluated on plain floats."""

    def __init__(self, tableau: Tableau) -> None:
        self.tableau = tableau
        self._rows = [np.array(row) for row in tableau.a]
        self._b = np.array(tableau.b)
        self._error = np.array(tableau.error)
        self._damping = np.array(tableau.damping)

    def step(self, f: Derivative, t: float, y: Vector, h: float) -> Step:
        """Advance y' = f(t, y) from t by h."""
        start = np.array(y)
        stages = np.empty((len(self._b), len(y)))
        stages[0] = f(t, y)
        for i in range(1, len(self._b)):
            inner = start + h * (self._rows[i] @ stages[:i])
            stages[i] = f(t + self.tableau.c[i] * h, tuple(inner.tolist()))
        end = start + h * (self._b @ stages)
        return Step(tuple(end.tolist()), self._estimate(stages, h))

    def _estimate(self, stages: NDArray[np.float64], h: float) -> float:
        if not len(self._error):
            return math.nan
        fine = float(np.linalg.norm(self._error @ stages))
        if not len(self._damping):
            return h * fine
        coarse = float(np.linalg.norm(self._damping @ stages))
        size = math.hypot(fine, 0.1 * coarse)
        return h * fine * fine / size if size > 0.0 else 0.0
