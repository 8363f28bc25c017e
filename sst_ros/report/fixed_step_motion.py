# SPDX-License-Identifier: Apache-2.0
"""A scene's equations of motion over many ticks by DOP853 with fixed steps, for references.

The equations are traced from the kernel; the loops are those of `integration.step_loops`, compiled
for long runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Program, trace
from sst_ros.dynamics.math_functions import positive, sin
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration import codegen
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS, Integers
from sst_ros.report import tick_kernel
from sst_ros.report.states import Vector
from sst_ros.scene.scene import Scene, SineTorque

COMPILED_FROM = 10_000
"""From this number of ticks on compilation costs less than it saves."""


class TickSequence(NamedTuple):
    """Ticks in order of time.

    Attributes:
        start_ns, end_ns: relative to the start of the run [ns], shape (m,).
        drives: what acts from outside over a tick, shape (m, 3 or 6 or 0).

    """

    start_ns: Integers
    end_ns: Integers
    drives: Array

    @property
    def lengths(self) -> Array:
        """Length of each tick [s]."""
        return np.asarray((self.end_ns - self.start_ns) / NANOSECONDS)

    def part(self, ticks: slice) -> TickSequence:
        """Return some of the ticks."""
        return TickSequence(self.start_ns[ticks], self.end_ns[ticks], self.drives[ticks])


class FixedStepMotion:
    """Motion of a scene, tick by tick.

    Args:
        scene: what moves.
        torque: torques over time, within the limit of the actuators; without them they are those
            of each tick.
        compiled: by numba, where it is installed.

    Attributes:
        dynamics: functions of the scene.
        compiled: whether numba is used.

    """

    def __init__(self, scene: Scene, torque: SineTorque | None, *, compiled: bool) -> None:
        self.dynamics = Dynamics.of(scene)
        self.compiled = compiled and codegen.numba_version() is not None
        drive = self.dynamics.drive if torque is None else ()
        size = len(self.dynamics.state)
        program = trace(
            _free(self.dynamics, torque, _limit(scene)) if torque else _held(self.dynamics),
            ("t", *self.dynamics.state, *drive),
        )
        self._module = module(program, self.dynamics, size, len(drive), compiled=self.compiled)

    def follow(self, y: Vector, ticks: TickSequence, counts: Integers) -> Array:
        """Integrate over ticks, each by its number of steps.

        Returns:
            States at the end of each tick that was done, shape (ticks, size); they are fewer than
            asked for where there is no finite continuation.

        """
        times, lengths, drives = ticks.start_ns / NANOSECONDS, ticks.lengths, ticks.drives
        reached = np.full((len(times), len(y)), np.nan)
        if self.compiled:
            drives = np.ascontiguousarray(drives)
            done = self._module.integrate_ticks(
                times, lengths, counts, drives, np.array(y), reached
            )
            return reached[:done]
        state = list(y)
        columns = (each.tolist() for each in (times, lengths, counts, drives))
        for k, row in enumerate(zip(*columns, strict=True)):
            end: list[list[float]] = [[0.0] * len(y)]
            try:
                done = self._module.integrate_ticks(*([each] for each in row), state, end)
            except (ArithmeticError, ValueError):
                done = 0
            if not done:
                return reached[:k]
            reached[k] = end[0]
        return reached


def recorded_ticks(recording: Recording) -> TickSequence:
    """Return the recorded ticks, torques within the limit of the actuators."""
    ticks, dynamics = recording.ticks, Dynamics.of(recording.scene)
    limit = _limit(recording.scene)
    torque = ticks.torque if limit is None else np.clip(ticks.torque, -limit, limit)
    if dynamics.moved and ticks.moment is not None:
        torque = np.hstack([torque, ticks.moment])
    return TickSequence(ticks.start_ns, ticks.end_ns, torque)


def module(
    program: Program, dynamics: Dynamics, size: int, drive: int, *, compiled: bool
) -> ModuleType:
    """Put the loops of `tick_kernel` behind DOP853 and a derivative of t, state, drive."""
    texts = codegen.source(program, None, dynamics.joints_program, DOP853, size, drive)
    texts += [
        inspect.getsource(tick_kernel.integrate_ticks),
        inspect.getsource(tick_kernel.work_done),
    ]
    # Lag and share concern error estimates, which are not used here.
    constants = {"SIZE": size, "LAG": 0, "SHARE": 1.0}
    return codegen.load(texts, constants, numba=compiled, nogil=True)


def _limit(scene: Scene) -> float | None:
    return scene.actuators.torque_limit if scene.actuators else None


def _held(dynamics: Dynamics) -> Any:
    size = len(dynamics.state)

    def slope(_: Any, *inputs: Any) -> Sequence[Any]:
        drive = inputs[size:]
        return kernel.derivative(dynamics.model, inputs[:size], drive[:3], drive[3:] or None)

    return slope


def _free(dynamics: Dynamics, torque: SineTorque, limit: float | None) -> Any:
    rows = list(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))

    def slope(t: Any, *state: Any) -> Sequence[Any]:
        asked = [a * sin(f * t + p) for a, f, p in rows]
        if limit is not None:
            asked = [limit - positive(2.0 * limit - positive(tau + limit)) for tau in asked]
        return kernel.derivative(dynamics.model, state, (asked[0], asked[1], asked[2]))

    return slope
