# SPDX-License-Identifier: Apache-2.0
"""Torques that act at the actuators: the given ones, within the actuators' limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration.point import Drive
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.torque_profile import SineTorque, Torque, TorqueProfile
from sst_ros.state import (
    LAGGED_TORQUES,
    NANOSECONDS,
    STAR,
    ZERO,
    State,
    Vector3,
    clamp,
)

_SEARCHED = 8
"""Parts of a step in which a jump is looked for."""
_TIME_STEP = 1e-7
"""Step of the derivative of a torque by time [s].

Its error is 1e-9 where the torque changes within 1 ms.
"""
_STATE_STEP = 1e-7
"""Step of its derivatives by the state, relative to numbers above 1.

Half of the digits remain.
"""
CHECKED_POINTS = 32
"""Parts of a step at whose ends a function of the time is looked at.

A pulse that is longer than one of them is met.
"""
_PULSE = 1e-3
"""Deviation from the neighbours that may be a jump, relative to the largest torque."""
_SMOOTH_PULSE = 0.1
"""...and one that is a smooth pulse, as no jump is found."""
_NOT_FINITE = (math.nan, math.nan, math.nan)


_EXTRAPOLATION = np.array([4.0, -6.0, 4.0, -1.0])
"""Weights of four evenly spaced values in the one before them, by a cubic."""


class Pulse(NamedTuple):
    """Where a torque does not follow from its neighbours."""

    begin: float  # time of the steps [s]
    end: float
    is_large: bool  # so that a step must not pass it, even if it is smooth


class AppliedTorque:
    """What the actuators give of a torque: it, within their limit.

    Args:
        dynamics: of the scene.
        limit: largest torque of an actuator [N m], or None.

    """

    def __init__(self, dynamics: Dynamics, limit: float | None) -> None:
        self._dynamics = dynamics
        self.limit = limit
        self._lags = len(dynamics.state) > 7

    def acting(self, torque: Torque) -> Torque:
        """Return what acts: torques that are held within the limit, others as given."""
        constant_torque = torque.held if isinstance(torque, TorqueProfile) else torque
        if constant_torque is None:
            return torque
        first, second, third = map(float, constant_torque)
        return clamp((first, second, third), self.limit)

    def limit_of(self, torque: SineTorque) -> float | None:
        """Return the limit of the actuators where it clamps a sine [N m]."""
        limit = self.limit
        if limit is None or max(map(abs, torque.amplitude)) <= limit:
            return None
        return limit

    def at(self, torque: Torque, time: float, y: Sequence[float]) -> Vector3:
        """Torques that act at a time [s] and a state y, within the limit [N m].

        Raises:
            InputError: what a function returns is not three finite numbers.

        """
        if not isinstance(torque, TorqueProfile):
            return clamp(torque, self.limit)
        if torque.feedback:
            return self.of_state(torque, time, y, self._dynamics.joints(*y[STAR]))
        return clamp(torque.at(time), self.limit)

    def of_state(
        self,
        torque: TorqueProfile,
        time: float,
        y: Sequence[float],
        joints: Sequence[float],
    ) -> Vector3:
        """Torques with feedback at a time [s] and a state y with its joints [N m].

        In the state that a function is given are the lagged torques of the actuators;
        without lag zero, for torques of this instant are what it returns. Where the
        state is not finite, as in a trial step that is too long, it is not called, and
        the torques are nan.
        """
        if not math.isfinite(sum(y)):
            return _NOT_FINITE
        lagged = triple(y[LAGGED_TORQUES]) if self._lags else ZERO
        state = State.of(round(time * NANOSECONDS), y, joints, lagged)
        return clamp(torque.at(time, state), self.limit)

    def at_times(
        self, torque: TorqueProfile, times: Sequence[float]
    ) -> Sequence[Vector3]:
        """Torques without feedback that act at times [s], within the limit [N m]."""
        torques = torque.at_times(times)
        limit = self.limit
        if limit is None:
            return torques
        return [clamp(each, limit) for each in torques]

    def of_drive(self, drive: Drive, t: float, y: Sequence[float]) -> Vector3:
        """Return the torques of a drive with a function [N m].

        They are those at a time of the steps [s] and a state.
        """
        assert drive.function is not None
        return self.at(drive.function, drive.start + t, y)

    def locate_jump(
        self, drive: Drive, begin: float, end: float, y: Sequence[float]
    ) -> tuple[float, float] | None:
        """Locate a jump of a function's torques: the last time before, the first after.

        Bisection keeps the half with the larger change: that of a jump stays, any other
        shrinks (Gear & Osterby, ACM Trans. Math. Softw. 10 (1984) 23-44, locate them
        for the same purpose).

        Between two times of the steps [s], at the same state y.
        """
        times = np.linspace(begin, end, _SEARCHED + 1).tolist()
        torques = [self.of_drive(drive, time, y) for time in times]
        changes = [math.dist(before, after) for before, after in pairwise(torques)]
        largest = max(changes)
        k = changes.index(largest)
        low, high = times[k], times[k + 1]
        before, after = torques[k], torques[k + 1]
        while low < (middle := 0.5 * (low + high)) < high:
            torque = self.of_drive(drive, middle, y)
            if math.dist(before, torque) >= math.dist(torque, after):
                high, after = middle, torque
            else:
                low, before = middle, torque
            if not math.dist(before, after) > 0.5 * largest:
                return None
        return low, high

    def find_pulse(self, drive: Drive, t: float, h: float) -> Pulse | None:
        """Find where a function of the time does not follow from its neighbours.

        Each of evenly spaced torques in a step is compared with the cubic polynomial
        through two on either side, or through four on one side near the ends. At the
        ends themselves are stages.
        """
        assert drive.function is not None
        spacing = h / CHECKED_POINTS
        times = [drive.start + t + spacing * k for k in range(CHECKED_POINTS + 1)]
        torques = np.array(self.at_times(drive.function, times))
        expected = torques.copy()
        inner = 4.0 * (torques[1:-3] + torques[3:-1]) - torques[:-4] - torques[4:]
        expected[2:-2] = inner / 6.0
        expected[1] = _EXTRAPOLATION @ torques[2:6]
        expected[-2] = _EXTRAPOLATION @ torques[-3:-7:-1]
        deviations = np.abs(torques - expected).max(axis=1)
        k = int(deviations.argmax())
        largest = float(np.abs(torques).max())
        deviation = float(deviations[k])
        if not deviation > _PULSE * largest:
            return None
        begin, end = t + spacing * (k - 1), t + spacing * (k + 1)
        return Pulse(begin, end, deviation > _SMOOTH_PULSE * largest)

    def rate(
        self, drive: Drive, t: float, y: Sequence[float], torque: Vector3
    ) -> Array:
        """Differentiate a function's torques by time [N m/s], shape (3,).

        The difference is forward from `torque`, as a step may begin at a kink, behind
        which the torque has another rate.
        """
        torque_after_one, torque_after_two = (
            np.array(self.of_drive(drive, t + k * _TIME_STEP, y)) for k in (1, 2)
        )
        return np.asarray(
            (4.0 * torque_after_one - torque_after_two - 3.0 * np.array(torque))
            / (2.0 * _TIME_STEP)
        )

    def by_state(
        self, drive: Drive, t: float, y: Sequence[float], torque: Vector3
    ) -> Array:
        """Differentiate a function's torques by the state, shape (3, size)."""
        slopes = np.zeros((3, len(y)))
        if drive.function is not None and drive.function.feedback:
            # the last number is the work, which no torque sees
            for i in range(len(y) - 1):
                step = _STATE_STEP * max(1.0, abs(y[i]))
                moved = [*y[:i], y[i] + step, *y[i + 1 :]]
                change = np.array(self.of_drive(drive, t, moved)) - torque
                slopes[:, i] = change / step
        return slopes
