# SPDX-License-Identifier: Apache-2.0
"""The reference of a controller, reference motions, and extremes of what they ask for."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sst_ros.mechanism.generic_math import ZERO, axpy, multiply
from sst_ros.state import Array, Quaternion, Vector3

PIECES = 8
"""Pieces of a minimum-jerk motion, and of a quarter of a turn."""
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Reference:
    """Desired state and acceleration at one instant; all parts describe the same motion.

    Attributes:
        quaternion: of {E} in {B}, (x, y, z, w), of length 1 up to rounding.
        body_rate: W in {E} [rad/s].
        body_acceleration: W_dot in {E} [rad/s^2].
        gamma, gamma_dot, gamma_ddot: actuators [rad], [rad/s], [rad/s^2].

    """

    quaternion: Quaternion
    body_rate: Vector3
    body_acceleration: Vector3
    gamma: Vector3
    gamma_dot: Vector3
    gamma_ddot: Vector3


class ReferenceMotion(ABC):
    """A desired motion; it rests before time 0 and after `duration`.

    Attributes:
        duration: [s].
        pieces: times from 0 to `duration` [s], rising. From one to the next the motion is so smooth
            that some ten samples resolve it.

    """

    def __init__(self, duration: float, pieces: tuple[float, ...]) -> None:
        self.duration = duration
        self.pieces = pieces

    def at(self, time: float) -> Reference:
        """Return the reference at a time [s]; at rest before 0 and after `duration`.

        Raises:
            SingularConfiguration: the motion meets a singularity there.

        """
        if 0.0 <= time <= self.duration:
            return self._inside(time)
        end = self._inside(0.0 if time < 0.0 else self.duration)
        return replace(end, body_rate=ZERO, body_acceleration=ZERO, gamma_dot=ZERO, gamma_ddot=ZERO)

    @abstractmethod
    def _inside(self, time: float) -> Reference:
        """Return the reference at a time [s] between 0 and `duration`."""


class StoppingMotion(ReferenceMotion):
    """Another motion from a time on, slowed down to rest by time scaling.

    Its time s has ds/dt = 1 - 3 u^2 + 2 u^3 with u = t / duration: 1 at first and 0 at the end,
    with d^2s/dt^2 = 0 at both. It stays on the path of the other motion, which is inside all
    limits of position, for half of `duration` more at most.

    Args:
        motion: the other motion.
        begin: its time from which it is slowed down [s].
        duration: time until it rests [s], > 0.

    """

    def __init__(self, motion: ReferenceMotion, begin: float, duration: float) -> None:
        super().__init__(duration, equal_pieces(duration, 4))
        self._motion, self._begin = motion, begin

    def _inside(self, time: float) -> Reference:
        u = time / self.duration
        at = self._motion.at(self._begin + self.duration * u * (1.0 - u * u * (1.0 - 0.5 * u)))
        speed = 1.0 - u * u * (3.0 - 2.0 * u)
        change = -6.0 * u * (1.0 - u) / self.duration

        def second(rate: Vector3, acceleration: Vector3) -> Vector3:
            return axpy(speed * speed, acceleration, change, rate)

        return Reference(
            at.quaternion,
            multiply(speed, at.body_rate),
            second(at.body_rate, at.body_acceleration),
            at.gamma,
            multiply(speed, at.gamma_dot),
            second(at.gamma_dot, at.gamma_ddot),
        )


def equal_pieces(duration: float, count: int) -> tuple[float, ...]:
    """Return the ends of `count` equal parts of a duration."""
    return (*(duration * (k / count) for k in range(count)), duration)


def minimum_jerk(u: float) -> tuple[float, float, float]:
    """s(u) from 0 to 1 for u in [0, 1], at rest at both ends, with its two derivatives by u."""
    rest = 1.0 - u
    square = u * u
    return (
        square * u * (10.0 + u * (6.0 * u - 15.0)),
        30.0 * square * rest * rest,
        60.0 * u * rest * (rest - u),
    )


def minimum_jerk_over(time: float, duration: float) -> tuple[float, float, float]:
    """Minimum jerk from 0 to 1 over a duration, with derivatives by time."""
    s, rate, acceleration = minimum_jerk(time / duration)
    return s, rate / duration, acceleration / (duration * duration)


@dataclass(frozen=True)
class Peak:
    """A value and the time at which it is taken [s]."""

    value: float
    time: float


def maximum(
    function: Callable[[float], float], times: Array, values: Array, floor: float = -math.inf
) -> Peak:
    """Return the maximum of a function of which samples are known.

    Every sample that no neighbour exceeds is a local maximum. It is refined between its neighbours
    if the function could exceed the best sample there: extrapolated by its change to the lower
    neighbour.

    Args:
        function: of time.
        times: of the samples, rising [s], shape (n,).
        values: the function there, shape (n,).
        floor: maxima that are certainly below it are not refined.

    """
    from scipy.optimize import minimize_scalar  # a node that plans no motion starts without SciPy

    top = int(np.argmax(values))
    best = Peak(float(values[top]), float(times[top]))
    left, right = np.append(-np.inf, values[:-1]), np.append(values[1:], -np.inf)
    below = np.minimum(np.append(values[0], values[:-1]), np.append(values[1:], values[-1]))
    high = 2.0 * values - below > max(best.value + _ROUNDING * abs(best.value), floor)
    summits = (values >= left) & (values >= right) & high
    for index in np.flatnonzero(summits):
        bounds = times[max(index - 1, 0)], times[min(index + 1, len(times) - 1)]
        options = {"xatol": 1e-8 * float(bounds[1] - bounds[0])}
        found = minimize_scalar(
            lambda time: -function(time), bounds=bounds, method="bounded", options=options
        )
        if -found.fun > best.value + _ROUNDING * abs(best.value):
            best = Peak(float(-found.fun), float(found.x))
    return best


def minimum(function: Callable[[float], float], times: Array, values: Array) -> Peak:
    """Return the minimum; see `maximum`."""
    found = maximum(lambda time: -function(time), times, -values)
    return Peak(-found.value, found.time)
