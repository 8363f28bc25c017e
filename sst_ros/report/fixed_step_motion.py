# SPDX-License-Identifier: Apache-2.0
"""The equations of motion of a scene over many ticks, with fixed steps: the reference's own way.

The method is DOP853 on the kernel's equations, traced, compiled for long runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import Program, trace
from sst_ros.dynamics.limits import limits_of
from sst_ros.dynamics.math_functions import positive, sin
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.integration import codegen
from sst_ros.integration.methods import DOP853
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS, Integers
from sst_ros.report import tick_kernel
from sst_ros.report.states import Vector
from sst_ros.scene.scene import Scene, SineTorque

TOUCHING = 1e-12
"""An actuator that is farther beyond its end than this [rad] has hit it."""

COMPILED_FROM = 10_000
"""From this number of ticks on it is worth compiling."""


class Course(NamedTuple):
    """Ticks to go through.

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

    def part(self, ticks: slice) -> Course:
        """Return some of the ticks."""
        return Course(self.start_ns[ticks], self.end_ns[ticks], self.drives[ticks])


class Motion:
    """Motion of a scene up to its next impact.

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
        ends = limits_of(scene, Geometry.of(scene))
        rigid = [(end.joint, end.sign, end.end) for end in ends if end.error is None]
        self._ends: Any = np.array(rigid).reshape(-1, 3) if self.compiled else rigid

    def follow(self, y: Vector, course: Course, counts: Integers) -> tuple[Array, bool]:
        """Go through ticks, each by its number of steps.

        Returns:
            States at the end of each tick that was done, shape (ticks, size); they are fewer than
            asked for after an impact, or where there is no finite continuation; and whether it
            was an impact.

        """
        times, lengths, drives = course.start_ns / NANOSECONDS, course.lengths, course.drives
        reached = np.full((len(times), len(y)), np.nan)
        if self.compiled:
            drives = np.ascontiguousarray(drives)
            given = times, lengths, counts, drives, self._ends, np.array(y), reached
            done, hit = self._module.ride(*given)
            return reached[:done], hit
        state = list(y)
        columns = (each.tolist() for each in (times, lengths, counts, drives))
        rows = zip(*columns, strict=True)
        for k, row in enumerate(rows):
            end: list[list[float]] = [[0.0] * len(y)]
            try:
                done, hit = self._module.ride(*([each] for each in row), self._ends, state, end)
            except (ArithmeticError, ValueError):
                done, hit = 0, False
            if not done:
                return reached[:k], hit
            reached[k] = end[0]
        return reached, False


def held(recording: Recording) -> Course:
    """Return the recorded ticks, torques within the limit of the actuators."""
    ticks, dynamics = recording.ticks, Dynamics.of(recording.scene)
    limit = _limit(recording.scene)
    torque = ticks.torque if limit is None else np.clip(ticks.torque, -limit, limit)
    if dynamics.moved and ticks.moment is not None:
        torque = np.hstack([torque, ticks.moment])
    return Course(ticks.start_ns, ticks.end_ns, torque)


def module(
    program: Program, dynamics: Dynamics, size: int, drive: int, *, compiled: bool
) -> ModuleType:
    """Put the loops of `ride` behind DOP853 and a derivative with the inputs t, state, drive."""
    texts = codegen.source(program, None, dynamics.joints_program, DOP853, size, drive)
    texts += [inspect.getsource(tick_kernel.ride), inspect.getsource(tick_kernel.work_done)]
    # Lag and share concern error estimates, which nobody looks at here.
    constants = {"SIZE": size, "LAG": 0, "SHARE": 1.0, "TOUCHING": TOUCHING}
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
