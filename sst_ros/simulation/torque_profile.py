# SPDX-License-Identifier: Apache-2.0
"""Torques as functions of time: constant, sine, table of held values, polynomial pieces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.scene.loads import SineTorque
from sst_ros.state import State, Vector3, finite_vector

Array = NDArray[np.float64]
TorqueFunction: TypeAlias = Callable[[float], Sequence[float]]
FeedbackFunction: TypeAlias = Callable[[float, State], Sequence[float]]


_MOST_CROSSINGS = 1e5
"""Radians of a sine beyond which its clamping is not computed in advance."""


class TorqueProfile:
    """Base of the torques that are known as a function of time alone."""

    def values(self, t: Array) -> Array:
        """Torques [N m] at times [s], shape (n,) -> (n, 3)."""
        raise NotImplementedError

    def breaks(self) -> Array:
        """Return the times [s] at which the torques or their derivatives jump, ascending."""
        return np.empty(0)

    def crossings(self, limit: float | None, end: float) -> Array:
        """Return the times from 0 to `end` [s] at which a torque passes the limit [N m], if any."""
        return np.empty(0)

    def between(self, begin: float, end: float) -> Callable[[float], Vector3]:
        """Torques [N m] on [begin, end], between which no break lies; ends belong to it."""
        return self

    def record(self) -> dict[str, Any]:
        """Numbers from which `profile_from` builds the same profile."""
        return {"kind": "function"}

    def __call__(self, t: float) -> Vector3:
        """Torques [N m] at a time [s]."""
        first, second, third = self.values(np.array([t]))[0].tolist()
        return first, second, third


@dataclass(frozen=True)
class ConstantTorque(TorqueProfile):
    """The same three torques [N m] at all times."""

    torque: Vector3

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        return np.tile(self.torque, (len(t), 1))

    def __call__(self, t: float) -> Vector3:
        """Torques [N m] at a time [s]."""
        return self.torque

    def record(self) -> dict[str, Any]:
        """See `TorqueProfile`."""
        return {"kind": "constant", "torque": self.torque}


@dataclass(frozen=True)
class SineProfile(TorqueProfile):
    """tau_k(t) = amplitude_k sin(frequency_k t + phase_k), from the section of a scene."""

    sine: SineTorque

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        return self.sine.values(t)

    def crossings(self, limit: float | None, end: float) -> Array:
        """See `TorqueProfile`."""
        found = [np.empty(0)]
        rows = zip(self.sine.amplitude, self.sine.frequency, self.sine.phase, strict=True)
        for amplitude, frequency, phase in rows:
            if limit is None or abs(amplitude) <= limit or not frequency:
                continue
            if abs(frequency) * end > _MOST_CROSSINGS:
                continue  # the step control has to find them
            angle = np.arcsin(limit / amplitude)
            first, last = sorted((phase, phase + frequency * end))
            turns = np.pi * np.arange(np.floor(first / np.pi) - 1, np.ceil(last / np.pi) + 2)
            for shift in (angle, -angle):
                found.append((turns + shift - phase) / frequency)
        times = np.unique(np.concatenate(found))
        return np.asarray(times[(times > 0.0) & (times < end)])

    def record(self) -> dict[str, Any]:
        """See `TorqueProfile`."""
        return {"kind": "sine", **vars(self.sine)}

    def __call__(self, t: float) -> Vector3:
        """Torques [N m] at a time [s], by the sine of the C library."""
        return self.sine.at(t)


class PolynomialTorque(TorqueProfile):
    """Polynomial pieces, in the layout of `scipy.interpolate.PPoly`; zero outside of them.

    Args:
        coefficients: highest power first, shape (order + 1, pieces, 3).
        breakpoints: beginnings of the pieces and the end of the last [s], shape (pieces + 1,).

    Raises:
        InputError: shapes, order or numbers are not allowed.

    """

    def __init__(self, coefficients: ArrayLike, breakpoints: ArrayLike) -> None:
        self.c, self.x = np.array(coefficients, dtype=float), np.array(breakpoints, dtype=float)
        if self.x.ndim != 1 or len(self.x) < 2 or np.any(np.diff(self.x) <= 0.0):
            allowed = "must be two or more ascending times [s]"
            raise InputError("torque", [Problem("breakpoints", breakpoints, allowed)])
        if self.c.ndim != 3 or self.c.shape[1:] != (len(self.x) - 1, 3):
            allowed = f"must have the shape (order + 1, {len(self.x) - 1}, 3)"
            raise InputError("torque", [Problem("coefficients", self.c.shape, allowed)])
        if not (np.all(np.isfinite(self.c)) and np.all(np.isfinite(self.x))):
            raise InputError("torque", [Problem("coefficients", "not finite", "must be finite")])

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        piece = np.clip(np.searchsorted(self.x, t, side="right") - 1, 0, self.c.shape[1] - 1)
        total: Array = np.zeros((len(t), 3))
        for factors in self.c[:, piece]:
            total = total * (t - self.x[piece])[:, None] + factors
        total[(t < self.x[0]) | (t > self.x[-1])] = 0.0
        return total

    def breaks(self) -> Array:
        """See `TorqueProfile`."""
        return self.x

    def crossings(self, limit: float | None, end: float) -> Array:
        """See `TorqueProfile`."""
        found = []
        for piece in range(0 if limit is None else self.c.shape[1]):
            length = self.x[piece + 1] - self.x[piece]
            for coefficients in self.c[:, piece].T:
                for bound in (limit, -limit) if limit is not None else ():
                    roots = np.roots([*coefficients[:-1], coefficients[-1] - bound])
                    real = roots.real[abs(roots.imag) <= 1e-9 * length]
                    found.append(self.x[piece] + real[(real > 0.0) & (real < length)])
        return np.unique(np.concatenate(found)) if found else np.empty(0)

    def between(self, begin: float, end: float) -> Callable[[float], Vector3]:
        """See `TorqueProfile`."""
        piece = int(np.searchsorted(self.x, 0.5 * (begin + end))) - 1
        if not 0 <= piece < self.c.shape[1]:
            return ConstantTorque((0.0, 0.0, 0.0))
        start = float(self.x[piece])
        first, second, third = self.c[:, piece].T.tolist()

        def value(c: list[float], t: float) -> float:
            total = 0.0
            for factor in c:
                total = total * (t - start) + factor
            return total

        return lambda t: (value(first, t), value(second, t), value(third, t))

    def record(self) -> dict[str, Any]:
        """See `TorqueProfile`."""
        return {"kind": "polynomial", "c": self.c.tolist(), "x": self.x.tolist()}


class FunctionTorque(TorqueProfile):
    """A function f(t) [s] -> three torques [N m]."""

    def __init__(self, function: TorqueFunction) -> None:
        self._function = function

    def __call__(self, t: float) -> Vector3:
        """Torques [N m] at a time [s]."""
        return three(self._function(t), f"torque({t:g})")

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        return np.array([self(float(time)) for time in t]).reshape(-1, 3)


class LostTorque(TorqueProfile):
    """Torques of a function that a file does not have: known at the samples alone."""

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`; they are nowhere known."""
        return np.full((len(t), 3), np.nan)


def three(value: Any, name: str) -> Vector3:
    """Return three finite numbers as floats.

    Raises:
        InputError: `value` is something else.

    """
    if (vector := finite_vector(value)) is not None:
        return vector
    allowed = "must be three finite numbers [N m], a profile, or a function f(t) or f(t, state)"
    raise InputError("simulate", [Problem(name, value, allowed)])
