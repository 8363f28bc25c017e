# SPDX-License-Identifier: Apache-2.0
"""Functions beyond + - * / that take whatever number the kernel runs on.

Floats use `math`; anything else brings the function as a method of its own type (traced
expressions) or through NumPy or mpmath.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

_ARRAYS = (np.ndarray, np.generic, complex)


def sqrt(x: Any) -> Any:
    """Square root."""
    return math.sqrt(x) if type(x) is float else _other("sqrt", x)


def tanh(x: Any) -> Any:
    """Hyperbolic tangent."""
    return math.tanh(x) if type(x) is float else _other("tanh", x)


def exp(x: Any) -> Any:
    """Exponential."""
    return math.exp(x) if type(x) is float else _other("exp", x)


def sin(x: Any) -> Any:
    """Sine."""
    return math.sin(x) if type(x) is float else _other("sin", x)


def positive(x: Any) -> Any:
    """Return x where x > 0 and 0 elsewhere; of a complex number the real part decides."""
    if type(x) is float:
        return x if x > 0.0 else 0.0
    if hasattr(x, "traced"):
        return x.traced("positive")
    return np.where(np.real(x) > 0, x, 0.0) if isinstance(x, _ARRAYS) else max(x, 0)


def atan2(y: Any, x: Any) -> Any:
    """Angle of the point (x, y); complex numbers as the analytic continuation near the reals."""
    if type(y) is float and type(x) is float:
        return math.atan2(y, x)
    for number in (y, x):
        if hasattr(number, "traced"):
            return number.traced("atan2", y, x)
    if np.iscomplexobj(y) or np.iscomplexobj(x):
        angle = np.arctan2(np.real(y), np.real(x))
        turned_x, turned_y = (
            x * np.cos(angle) + y * np.sin(angle),
            y * np.cos(angle) - x * np.sin(angle),
        )
        return angle + np.arctan(turned_y / turned_x)
    return _other("atan2", y, x)


def _other(name: str, *arguments: Any) -> Any:
    first = arguments[0]
    if hasattr(first, "traced"):
        return first.traced(name)
    if isinstance(first, (*_ARRAYS, int)):
        return getattr(np, {"atan2": "arctan2"}.get(name, name))(*arguments)
    import mpmath

    return getattr(mpmath, name)(*arguments)
