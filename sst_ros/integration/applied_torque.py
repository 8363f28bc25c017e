# SPDX-License-Identifier: Apache-2.0
"""Torques that act at the actuators: the commanded ones within the limit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sst_ros.dynamics.traced_dynamics import STATE_SIZE, Dynamics
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

_SEARCHED_PARTS = 8
"""Parts of a step, of which the one with the largest change is searched for a jump."""
_JUMP_SHARE = 0.5
"""Share of a change that remains while a part is halved, if the change is a jump."""
_TIME_STEP = 1e-7
"""Step of the difference by time of a function's torques [s].

The relative error is 1e-9 where a torque changes within 1 ms.
"""
_STATE_STEP = 1e-7
"""Step of the differences by the state, relative to numbers above 1.

Half of the digits remain.
"""
CHECKED_POINTS = 32
"""Parts of a step at whose ends a function of the time is evaluated to find pulses.

A pulse that is longer than a part is met.
"""
_PULSE = 1e-3
"""Least deviation from the neighbours, relative to the largest torque, of a pulse."""
_SMOOTH_PULSE = 0.1
"""Least deviation, alike, of a pulse for which a step is shortened without a jump."""
_SPIKE = 30.0
"""Least deviation at a kink, relative to one that a quarter of all do not exceed."""
_LEAST_SPIKE = 1e-9
"""...and relative to the largest torque: a kink that a step ends at is seen by the next
one, as its time is rounded by `_KINK_HALVINGS`."""
_KINK_HALVINGS = 38
"""Times that a span with a kink is halved: 5e-13 of the step remain.

The last stage of a step is off by the slope's change times what remains, and counts
with its weight: 2e-9 of a step made an error of 5e-12 rad.
"""
_KINK_SHARE = 0.125
"""Least bend of a kink after n halvings, relative to the first bend times 2^-n.

It is a half or more; that of a smooth function falls as 4^-n.
"""
_NOT_FINITE = (math.nan, math.nan, math.nan)
_EXTRAPOLATION = np.array([4.0, -6.0, 4.0, -1.0])
"""Weights of four evenly spaced values in the one before them, by a cubic."""


class Pulse(NamedTuple):
    """Span of time in a step in which torques do not follow from their neighbours.

    It may be a pulse, a jump or a kink.
    """

    begin: float  # time of the steps [s]
    end: float
    is_large: bool  # so that a step must not pass it, even if it is smooth


class AppliedTorque:
    """Torques that the actuators give: the commanded ones within their limit.

    Args:
        dynamics: of the scene.
        limit: largest torque of an actuator [N m], or None.

    """

    def __init__(self, dynamics: Dynamics, limit: float | None) -> None:
        self._dynamics = dynamics
        self.limit = limit
        self._lags = len(dynamics.state) > STATE_SIZE

    def acting(self, torque: Torque) -> Torque:
        """Return constant torques within the limit, and other torques as they are."""
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
        """Return the torques within the limit at a time [s] and a state y [N m].

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
        """Return torques with feedback at a time [s] and a state with its joints [N m].

        The `State` that a function gets has the torques of the actuators where they
        lag, and zero where they do not, as the function itself gives those. It is not
        called where the state is not finite, as in a trial step that is too long: the
        torques are nan.
        """
        if not math.isfinite(sum(y)):
            return _NOT_FINITE
        lagged = triple(y[LAGGED_TORQUES]) if self._lags else ZERO
        state = State.of(round(time * NANOSECONDS), y, joints, lagged)
        return clamp(torque.at(time, state), self.limit)

    def at_times(
        self, torque: TorqueProfile, times: Sequence[float]
    ) -> Sequence[Vector3]:
        """Return torques without feedback at times [s], within the limit [N m]."""
        torques = torque.at_times(times)
        limit = self.limit
        if limit is None:
            return torques
        return [clamp(each, limit) for each in torques]

    def of_drive(self, drive: Drive, t: float, y: Sequence[float]) -> Vector3:
        """Return the torques of a drive with a function [N m].

        Time is that of the steps [s].
        """
        assert drive.function is not None
        return self.at(drive.function, drive.start + t, y)

    def of_drive_at_times(
        self, drive: Drive, times: Sequence[float]
    ) -> Sequence[Vector3]:
        """Return the torques of a drive without feedback at times of the steps [s]."""
        assert drive.function is not None
        return self.at_times(drive.function, [drive.start + time for time in times])

    def locate_jump(
        self, drive: Drive, begin: float, end: float, y: Sequence[float]
    ) -> tuple[float, float] | None:
        """Locate a jump of a function's torques between two times of the steps [s].

        Bisection keeps the half with the larger change: that of a jump stays, any other
        shrinks (Gear & Osterby, ACM Trans. Math. Softw. 10 (1984) 23-44, locate them
        for the same purpose). All torques are those at the state y.

        Returns:
            The last time before the jump and the first after it; None without a jump.

        """
        times = np.linspace(begin, end, _SEARCHED_PARTS + 1).tolist()
        torques = [self.of_drive(drive, time, y) for time in times]
        changes = [math.dist(before, after) for before, after in pairwise(torques)]
        largest = max(changes)
        k = changes.index(largest)
        low, high = times[k], times[k + 1]
        before, after = torques[k], torques[k + 1]
        middle = 0.5 * (low + high)
        while low < middle < high:  # until the two times are neighbours as doubles
            torque = self.of_drive(drive, middle, y)
            if math.dist(before, torque) >= math.dist(torque, after):
                high = middle
                after = torque
            else:
                low = middle
                before = torque
            if not math.dist(before, after) > _JUMP_SHARE * largest:
                return None
            middle = 0.5 * (low + high)
        return low, high

    def find_pulse(self, drive: Drive, t: float, h: float) -> Pulse | None:
        """Find where torques over time follow least from their neighbours in a step.

        The step is from t [s] of the steps on, h [s] long. None where they follow.
        """
        spacing = h / CHECKED_POINTS
        times = [t + spacing * k for k in range(CHECKED_POINTS + 1)]
        torques = np.array(self.of_drive_at_times(drive, times))
        deviations = np.abs(torques - _expect_torques(torques)).max(axis=1)
        largest = float(np.abs(torques).max())
        deviation = float(deviations.max())
        inner = deviations[2:-2]  # by neighbours on both sides
        k = 2 + int(inner.argmax())
        usual = float(np.sort(inner)[len(inner) // 4])
        is_spike = deviations[k] > max(_SPIKE * usual, _LEAST_SPIKE * largest)
        if not (is_spike or deviation > _PULSE * largest):
            return None
        # What is halfway between two points shows at two on either side alike.
        begin, end = t + spacing * (k - 2), t + spacing * (k + 2)
        return Pulse(begin, end, deviation > _SMOOTH_PULSE * largest)

    def locate_kink(self, drive: Drive, begin: float, end: float) -> float | None:
        """Locate a kink of torques over time between two times of the steps [s].

        Of the halves of a span and the half in its middle, that with the largest bend
        is kept: the bend of a kink is proportional to the span, that of a smooth
        function to its square.
        """
        times = np.linspace(begin, end, 5).tolist()
        torques = np.array(self.of_drive_at_times(drive, times))
        first_bend = math.nan
        for halvings in range(_KINK_HALVINGS):
            bends = np.abs(torques[:-2] - 2.0 * torques[1:-1] + torques[2:]).max(axis=1)
            k = int(bends.argmax())
            bend = float(bends[k])
            if halvings == 0:
                first_bend = bend
            if not bend > _KINK_SHARE * first_bend * 0.5**halvings:
                return None
            low, middle, high = times[k : k + 3]
            quarters = [0.5 * (low + middle), 0.5 * (middle + high)]
            times = [low, quarters[0], middle, quarters[1], high]
            between = self.of_drive_at_times(drive, quarters)
            torques = np.array(
                [torques[k], between[0], torques[k + 1], between[1], torques[k + 2]]
            )
        return float(times[2])

    def rate(
        self, drive: Drive, t: float, y: Sequence[float], torque: Vector3
    ) -> Array:
        """Differentiate a function's torques by time [N m/s], shape (3,).

        The difference is forward from `torque`, as a step may begin at a kink, behind
        which the torque has another rate.
        """
        after_one = np.array(self.of_drive(drive, t + _TIME_STEP, y))
        after_two = np.array(self.of_drive(drive, t + 2.0 * _TIME_STEP, y))
        difference = 4.0 * after_one - after_two - 3.0 * np.array(torque)
        return np.asarray(difference / (2.0 * _TIME_STEP))

    def by_state(
        self, drive: Drive, t: float, y: Sequence[float], torque: Vector3
    ) -> Array:
        """Differentiate a function's torques by the state, shape (3, size)."""
        slopes = np.zeros((3, len(y)))
        if drive.function is None or not drive.function.feedback:
            return slopes
        # No torque depends on the work, the last number.
        for i in range(len(y) - 1):
            step = _STATE_STEP * max(1.0, abs(y[i]))
            moved = list(y)
            moved[i] += step
            change = np.array(self.of_drive(drive, t, moved)) - torque
            slopes[:, i] = change / step
        return slopes


def _expect_torques(torques: Array) -> Array:
    """Return evenly spaced torques as they follow from their neighbours, shape (n, 3).

    Each is that of the cubic polynomial through two on either side, or through four on
    one side near the ends. The first and the last, at which stages are, are as given.
    """
    expected: Array = torques.copy()
    inner = 4.0 * (torques[1:-3] + torques[3:-1]) - torques[:-4] - torques[4:]
    expected[2:-2] = inner / 6.0
    expected[1] = _EXTRAPOLATION @ torques[2:6]
    expected[-2] = _EXTRAPOLATION @ torques[-3:-7:-1]
    return expected
