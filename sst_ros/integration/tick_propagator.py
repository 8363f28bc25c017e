# SPDX-License-Identifier: Apache-2.0
"""A recorded run propagated again, tick by tick, under the torques of each tick."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.integration.adaptive_stepper import CannotStep, EvaluationBudget
from sst_ros.integration.codegen import numba_version
from sst_ros.integration.methods import DOP853
from sst_ros.integration.propagator import LimitReached, Propagator
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.scene import Scene, SineTorque
from sst_ros.state import NANOSECONDS

Integers = NDArray[np.int64]

LONGEST_NS = 1_000_000
"""Longer ticks are divided [ns]: a pair of steps then takes half a millisecond each."""

TOLERANCE = 1e-13
"""Largest local error estimate of a pair of steps."""

BUDGET = 3600
"""Evaluations that a tick may take: a hundred pairs of steps."""


class TickSequence(NamedTuple):
    """Ticks in order of time.

    Attributes:
        start_ns, end_ns: relative to the start of the run [ns], shape (m,).
        drives: what is held over a tick, shape (m, 3 or 6 or 0): actuator torques [N m], and a
            moment on the star in {B} [N m] if it comes from a topic.

    """

    start_ns: Integers
    end_ns: Integers
    drives: Array

    def part(self, ticks: slice) -> TickSequence:
        """Return some of the ticks."""
        return TickSequence(self.start_ns[ticks], self.end_ns[ticks], self.drives[ticks])


class TickPropagator(Propagator):
    """Propagates a scene by DOP853 through ticks, all of one call in compiled code.

    Limits of the scene do not end the motion.

    Args:
        scene: what moves.
        torque: torques over time, within the limit of the actuators; without them they are those
            of each tick.
        compiled: by numba, where it is installed.

    """

    def __init__(self, scene: Scene, torque: SineTorque | None, *, compiled: bool) -> None:
        self.compiled = compiled and numba_version() is not None
        budget = EvaluationBudget(BUDGET)
        super().__init__(
            scene, DOP853.name, TOLERANCE, compiled=self.compiled, budget=budget, limits=False
        )
        self._sine = torque

    def follow(self, ticks: TickSequence, starts: Array) -> Array:
        """Propagate through ticks.

        Args:
            ticks: m ticks.
            starts: states (quaternion, body rate, lagged torques) at which ticks begin, shape
                (m, 7 or 10); NaN where a tick goes on from the one before.

        Returns:
            Solution and coarse solution at the end of each tick, with the work since the start
            [J], shape (m, 2, 8 or 11); NaN from a tick that no step resolves to the next start.

        """
        length_ns = ticks.end_ns - ticks.start_ns
        parts = np.maximum(1, -(-length_ns // LONGEST_NS))
        first = np.cumsum(parts) - parts
        length = np.repeat(length_ns / NANOSECONDS / parts, parts)
        begin = np.repeat(ticks.start_ns / NANOSECONDS, parts)
        begin += length * (np.arange(len(length)) - np.repeat(first, parts))
        begins = np.full((len(length), len(self.ode.state)), np.nan)
        begins[first] = np.hstack([starts, 0.0 * starts[:, :1]])
        reached = self._reached(begin, length, self._drives(begin, ticks, parts), begins)
        return np.asarray(reached[first + parts - 1])

    def _drives(self, begin: Array, ticks: TickSequence, parts: Integers) -> Array:
        """Return the drives of the parts of ticks: torques within the limit, or phases of sines."""
        if self._sine is not None:
            phases = np.multiply.outer(begin, self._sine.frequency) + self._sine.phase
            return np.asarray(np.fmod(phases, 2.0 * np.pi))
        drives = np.repeat(ticks.drives, parts, axis=0)
        if self.torque.limit is not None:
            drives[:, :3] = np.clip(drives[:, :3], -self.torque.limit, self.torque.limit)
        return drives

    def _reached(self, begin: Array, length: Array, drives: Array, starts: Array) -> Array:
        reached: Any = np.full((len(length), 2, len(self.ode.state)), np.nan)
        given: Any = (length, drives, starts)
        if not self.compiled:
            reached, given = reached.tolist(), tuple(array.tolist() for array in given)
        stepper = self._stepper_for(self._sine or (0.0, 0.0, 0.0))
        at, k = self.begin(starts[0, :-1].tolist()), 0
        while k < len(length):
            k, at = stepper.step_sequence(k, given, at, reached)
            if k == len(length):
                break
            held = tuple(drives[k].tolist())
            torque = self._sine or (held[0], held[1], held[2])
            try:
                at, _ = self.advance(at, float(begin[k]), float(length[k]), 1, torque, held[3:])
                reached[k][0][:], reached[k][1][:] = at.y, at.z
                k += 1
            except (LimitReached, CannotStep, ArithmeticError, ValueError):
                later = np.flatnonzero(np.isfinite(starts[k + 1 :, 0]))
                k = k + 1 + int(later[0]) if len(later) else len(length)
        return np.asarray(reached)
