# SPDX-License-Identifier: Apache-2.0
"""Absolute stability."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.integration.compiled_method import Method
from sst_ros.integration.methods import METHODS, Rosenbrock
from sst_ros.mechanism.geometry import Array

FAR = -1e12
"""Where the stability function of an L-stable method has vanished."""


def stability_function(method: Method, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Evaluate R(z) of a method from its coefficients, for any shape of z."""
    stages: list[Any] = []
    one = np.ones_like(z)
    if isinstance(method, Rosenbrock):
        for a, c in zip(method.a, method.c, strict=True):
            at = one + _weighted(a, stages)
            stages.append((z * at + _weighted(c, stages)) / (4.0 - z))
        return np.asarray(at + stages[-1])
    for row in method.a:
        stages.append(one + z * _weighted(row, stages))
    return np.asarray(one + z * _weighted(method.b, stages))


def _weighted(weights: tuple[float, ...], stages: list[Any]) -> Any:
    return sum((w * k for w, k in zip(weights, stages, strict=False) if w), 0.0)


def regions(
    x: tuple[float, float] = (-8.0, 2.0), y: tuple[float, float] = (-6.0, 6.0), points: int = 401
) -> tuple[Array, Array, dict[str, Array]]:
    """Return a grid of z, shapes (points,), and abs(R) of every method on it."""
    real, imaginary = np.linspace(*x, points), np.linspace(*y, points)
    z = real[None, :] + 1j * imaginary[:, None]
    found = {name: np.abs(stability_function(method, z)) for name, method in METHODS.items()}
    return real, imaginary, found
