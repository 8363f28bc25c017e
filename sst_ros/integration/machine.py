# SPDX-License-Identifier: Apache-2.0
"""The steps of one scene by one method, on plain floats or compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from sst_ros.integration import backend
from sst_ros.integration.system import System
from sst_ros.integration.tableaux import Rosenbrock, Tableau
from sst_ros.mechanism.compiled import LAG

Method = Tableau | Rosenbrock
Vector = Sequence[float]
Slope = Callable[..., tuple[float, ...]]


class Machine:
    """Steps of a system by a method.

    Args:
        system: what is integrated.
        method: how.
        compiled: by numba; otherwise, or where there is no numba, as plain Python.
        slope: rhs(t, state.., drive..) to use instead of the system's, plain and explicit only.

    """

    def __init__(
        self, system: System, method: Method, *, compiled: bool, slope: Slope | None = None
    ) -> None:
        self.system = system
        self.method = method
        self.compiled = compiled = compiled and backend.numba_version() is not None
        implicit = isinstance(method, Rosenbrock)
        if slope is not None and (implicit or compiled):
            raise ValueError("a slope of its own needs an explicit method and plain Python")
        texts = backend.source(
            system.program,
            system.jacobian if implicit else None,
            method,
            len(system.state),
            len(system.drive),
        )
        self._module: ModuleType = backend.load(texts, self._constants(), numba=compiled)
        if slope is not None:
            self._module.__dict__["rhs"] = slope
        self._vector: Callable[[Vector], Any] = np.array if compiled else list
        self._error = self._vector([0.0] * len(system.state))

    def pair(
        self, t: float, h: float, y: Vector, z: Vector, d: Vector
    ) -> tuple[list[float], list[float], float]:
        """Two steps of h / 2 for y, one of h for its companion z.

        Returns:
            New y, new z, and the local error estimate of y in units of the tolerance; infinite
            where the step has no finite result.

        """
        new_y, new_z = self._vector(y), self._vector(z)
        try:
            size = self._module.pair(
                t, h, self._vector(y), self._vector(z), self._vector(d), new_y, new_z, self._error
            )
        except (ArithmeticError, ValueError):
            return list(y), list(z), float("inf")
        return self._listed(new_y), self._listed(new_z), float(size)

    def march(self, t: float, h: float, count: int, y: Vector, d: Vector) -> list[float]:
        """Advance by `count` steps of h, errors unseen.

        Raises:
            ArithmeticError, ValueError: in plain Python, where a step has no finite result.

        """
        new = self._vector(y)
        self._module.march(t, h, count, self._vector(y), self._vector(d), new)
        return self._listed(new)

    def _listed(self, y: Any) -> list[float]:
        listed: list[float] = y.tolist() if self.compiled else y
        return listed

    def _constants(self) -> dict[str, Any]:
        lag = 3 if set(LAG) <= set(self.system.state) else 0
        share = 0.5**self.method.error_order
        constants: dict[str, Any] = {"SIZE": len(self.system.state), "LAG": lag, "SHARE": share}
        if isinstance(self.method, Rosenbrock):
            # numba wants rows of one length.
            padded = [
                tuple((*row, *(0.0,) * (5 - len(row))) for row in table)
                for table in (self.method.a, self.method.c)
            ]
            constants |= {"RODAS_A": padded[0], "RODAS_C": padded[1]}
            constants |= {"RODAS_ALPHA": self.method.alpha, "RODAS_D": self.method.d}
        return constants
