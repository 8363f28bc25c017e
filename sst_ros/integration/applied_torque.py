# SPDX-License-Identifier: Apache-2.0
"""Torques over one period: three numbers, sines, or a function of time or of time and state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from sst_ros.dynamics.expression import compile_program
from sst_ros.dynamics.traced_dynamics import Dynamics, Function, ode_with_work
from sst_ros.scene.torque_profile import SineTorque, Torque, torque_at
from sst_ros.state import NANOSECONDS, State, Vector3, clamp

_SEARCHED = 8
"""Parts of a step in which a jump is looked for."""
_TIME_STEP = 1e-7
"""For the derivative of a torque by time [s]: an error of 1e-9 where it changes within 1 ms."""
_STATE_STEP = 1e-7
"""For its derivatives by the state, relative to numbers above 1: half of the digits remain."""


class AppliedTorque:
    """Derivative of the state under a torque function, and the clamp of the actuators.

    Args:
        dynamics: its equations with work have the torques in their drive.
        limit: largest torque of an actuator [N m], or None.
        derivative: of the state in place of that of these equations, with their inputs;
            `is_traced` says that there is none.

    """

    def __init__(
        self, dynamics: Dynamics, limit: float | None, derivative: Function | None
    ) -> None:
        self._dynamics, self._ode, self.limit = dynamics, ode_with_work(dynamics), limit
        self.is_traced = derivative is None
        if derivative is not None:
            self.rhs = derivative
        self._torque: Torque = (0.0, 0.0, 0.0)
        self._start = 0.0

    @cached_property
    def rhs(self) -> Function:
        """The derivative under torques that are numbers; machine code may take its place."""
        return compile_program(self._ode.program)

    def acting(self, torque: Torque) -> Torque:
        """Return what acts: numbers within the limit of the actuators; functions as they are.

        A sine becomes a function where it is no part of the program: the actuators clamp it, or
        the derivative was given.
        """
        if isinstance(torque, SineTorque):
            return torque if self.is_traced and self.limit_of(torque) is None else torque.at
        if callable(torque):
            return torque
        first, second, third = map(float, torque)
        return clamp((first, second, third), self.limit)

    def limit_of(self, torque: SineTorque) -> float | None:
        """Return the limit of the actuators where it clamps a sine [N m]."""
        limit = self.limit
        return None if limit is None or max(map(abs, torque.amplitude)) <= limit else limit

    def begin(self, torque: Torque, start: float) -> Vector3:
        """Take what acts in a period that begins at `start` [s].

        Returns:
            Three numbers of the drive: phases of a sine [rad], else zero.

        """
        if isinstance(torque, SineTorque):
            rows = zip(torque.frequency, torque.phase, strict=True)
            first, second, third = (math.fmod(f * start + p, math.tau) for f, p in rows)
            return first, second, third
        self._torque, self._start = torque, start
        return (0.0, 0.0, 0.0)

    def at(self, torque: Torque, time: float, y: Sequence[float]) -> Vector3:
        """Torques that act at a time [s] and a state y, within the limit [N m].

        In the state that a function is given are the lagged torques of the actuators; without lag
        zero, for torques of this instant are what it returns.

        Raises:
            ArithmeticError: the state is not finite, as in a trial step that is too long.

        """
        given: tuple[Any, ...] = (time,)
        if _has_feedback(torque):
            if not math.isfinite(sum(y)):
                raise ArithmeticError("the state of a trial step is not finite")
            lagged = (y[7], y[8], y[9]) if len(self._dynamics.state) > 7 else (0.0, 0.0, 0.0)
            joints = self._dynamics.joints(*y[:7])
            given = time, State.of(round(time * NANOSECONDS), y, joints, lagged)
        found: Any = tuple(map(float, torque_at(torque, *given)))
        if len(found) != 3:  # a ValueError would count as a motion that diverges
            raise TypeError(f"a torque function must return three torques [N m], not {len(found)}")
        return clamp(found, self.limit)

    def derivative(self, t: float, *inputs: Any) -> tuple[float, ...]:
        """Differentiate the state by time; inputs are its numbers, then those of the drive."""
        size = len(self._ode.state)
        torque = self.at(self._torque, self._start + t, inputs[:size])
        return self.rhs(t, *inputs[:size], *torque, *inputs[size + 3 :])

    def jump(self, begin: float, end: float, y: Sequence[float]) -> tuple[float, float] | None:
        """Locate a jump of a function's torques: the last time before it and the first one after.

        Bisection keeps the half with the larger change: that of a jump stays, any other shrinks
        (Gear & Osterby, ACM Trans. Math. Softw. 10 (1984) 23-44, locate them for the same purpose).

        Between two times of the derivative [s], at the same state y.
        """
        torque = self._torque

        def acting(time: float) -> Vector3:
            return self.at(torque, self._start + time, y)

        times = np.linspace(begin, end, _SEARCHED + 1).tolist()
        found = [acting(time) for time in times]
        changes = [math.dist(a, b) for a, b in pairwise(found)]
        most = max(changes)
        k = changes.index(most)
        (low, high), (before, after) = times[k : k + 2], found[k : k + 2]
        while low < (middle := 0.5 * (low + high)) < high:
            here = acting(middle)
            if math.dist(before, here) >= math.dist(here, after):
                high, after = middle, here
            else:
                low, before = middle, here
            if not math.dist(before, after) > 0.5 * most:
                return None
        return low, high

    def linearise(
        self, t: float, y: Sequence[float], d: Sequence[float], _: Any, slope: Any, by_time: Any,
        matrix: Any,
    ) -> None:  # fmt: skip
        """Fill in derivative, df/dt and df/dy: exact by the state, by differences of the torque.

        See `CompiledMethod` for the arguments.
        """
        torque, size = self._torque, len(self._ode.state)
        assert torque is not None
        time = self._start + t
        now = self.at(torque, time, y)
        found = self._ode.linearised_by_torque(t, *y, *now, *d[3:])
        slope[:] = found[:size]
        rows = np.array(found[2 * size :]).reshape(size + 3, size).T
        by_state, by_torque = rows[:, :size], rows[:, size:]
        # Forward: a step may begin at a kink, behind which the torque has another rate.
        near, far = (np.array(self.at(torque, time + k * _TIME_STEP, y)) for k in (1, 2))
        rate = (4.0 * near - far - 3.0 * np.array(now)) / (2.0 * _TIME_STEP)
        by_time[:] = (np.array(found[size : 2 * size]) + by_torque @ rate).tolist()
        if _has_feedback(torque):
            turns = np.zeros((3, size))
            for i in range(size - 1):  # the last number is the work, which no torque sees
                step = _STATE_STEP * max(1.0, abs(y[i]))
                moved = [*y[:i], y[i] + step, *y[i + 1 :]]
                turns[:, i] = (np.array(self.at(torque, time, moved)) - now) / step
            by_state = by_state + by_torque @ turns
        for i, row in enumerate(by_state.tolist()):
            matrix[i][:] = row


def _has_feedback(torque: Torque) -> bool:
    return bool(getattr(torque, "feedback", False))
