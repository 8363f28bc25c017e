# SPDX-License-Identifier: Apache-2.0
"""How far a recorded run is from the solution: the run, integrated again, at high accuracy.

The method is DOP853 with two or more steps a tick, on the kernel's equations; nothing of
`Simulation` takes part. Every comparison integrates twice, with different step sizes; the
difference of the two is the reference's own error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sst_ros.control.torque import Profile, sine
from sst_ros.integration.explicit import ExplicitMethod
from sst_ros.integration.tableaux import DOP853
from sst_ros.mechanism import kernel
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.report import states
from sst_ros.report.recording import Recording
from sst_ros.report.rows import NANOSECONDS
from sst_ros.report.states import Vector

LONGEST_STEP_NS = 500_000
"""Steps of the reference are not longer than this [ns]."""

METHOD = ExplicitMethod(DOP853)


@dataclass(frozen=True)
class Deviation:
    """Distance between two motions at each sample, shape (n,); nan where there is nothing to say.

    Attributes:
        gamma: largest difference of the actuator angles [rad].
        gamma_dot: largest difference of the actuator rates [rad/s].
        orientation: angle of the rotation between the orientations of {E} [rad].

    """

    gamma: Array
    gamma_dot: Array
    orientation: Array


@dataclass(frozen=True)
class Comparison:
    """A recording against a reference.

    Attributes:
        error: recording against reference.
        own: the reference's own error.
        restarts_ns: instants at which the reference had to begin again from a recorded sample,
            because torques before it were lost [ns].
        steps: steps a tick of the reference.

    """

    error: Deviation
    own: Deviation
    restarts_ns: tuple[int, ...]
    steps: int

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(np.count_nonzero(np.isfinite(self.error.gamma)))


def integration(recording: Recording) -> Comparison:
    """Compare with the exact motion under the recorded torques: what the integrator got wrong.

    A sample from which the reference begins again is not compared, and neither are samples
    between lost torques and the next beginning.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    return _compare(recording, lambda model, steps: _held(recording, model, steps))


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under the scene's continuous torques: what hold and transport cost.

    None where the scene has no torques or the recording lacks the start of the run.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    torque = recording.scene.torque
    if torque is None or not states.begins(recording):
        return None
    profile = sine(torque)
    return _compare(recording, lambda model, steps: (_free(recording, model, profile, steps), ()))


def _compare(
    recording: Recording, solve: Callable[[kernel.Model, int], tuple[Array, tuple[int, ...]]]
) -> Comparison:
    model = kernel.model_of(recording.scene)
    coarse = max(2, math.ceil(recording.ticks.period_ns / LONGEST_STEP_NS))
    fine = math.ceil(1.5 * coarse)
    rough = states.outputs(model, solve(model, coarse)[0])
    solved, restarts = solve(model, fine)
    reference = states.outputs(model, solved)
    sampled = (recording.quaternion, recording.gamma, recording.gamma_dot)
    error = _deviation(sampled, reference)
    for values in (error.gamma, error.gamma_dot, error.orientation):
        values[np.isin(recording.time_ns, restarts)] = np.nan
    return Comparison(error, _deviation(rough, reference), restarts, fine)


def _deviation(first: tuple[Array, Array, Array], second: tuple[Array, Array, Array]) -> Deviation:
    # Angles are told up to whole turns: a recorded one may count them, a computed one does not.
    turn = 2.0 * np.pi
    difference = first[1] - second[1]
    gamma = np.abs(difference - turn * np.round(difference / turn))
    return Deviation(
        gamma.max(axis=1),
        np.abs(first[2] - second[2]).max(axis=1),
        angle_between(first[0], second[0]),
    )


def _held(recording: Recording, model: kernel.Model, steps: int) -> tuple[Array, tuple[int, ...]]:
    """States at the samples, shape (n, 7), under the recorded torques, and the restarts [ns]."""
    result = np.full((len(recording.time_ns), 7), np.nan)
    sample_at = {int(time): row for row, time in enumerate(recording.time_ns)}
    geometry = Geometry.of(recording.scene)
    restarts: list[int] = []
    now = 0
    y: Vector | None = None
    if states.begins(recording):
        y = states.initial(recording.scene)
        result[0] = y
    ticks = recording.ticks
    for start, end, row in zip(
        ticks.start_ns.tolist(), ticks.end_ns.tolist(), ticks.torque.tolist(), strict=True
    ):
        if y is None or now != start:
            sample = sample_at.get(start)
            y = None if sample is None else states.recorded(geometry, recording, sample)
            if y is None:
                continue
            restarts.append(start)
        y = _advance(model, _constant(row), start, end, y, steps)
        now = end
        if y is not None and end in sample_at:
            result[sample_at[end]] = y
    return result, tuple(restarts)


def _free(recording: Recording, model: kernel.Model, profile: Profile, steps: int) -> Array:
    """States at the samples, shape (n, 7), under a continuous torque."""
    times, tick = recording.time_ns.tolist(), recording.ticks.period_ns
    result = np.full((len(times), 7), np.nan)
    y = states.initial(recording.scene)
    result[0] = y
    for row in range(1, len(times)):
        start, end = times[row - 1], times[row]
        count = steps * math.ceil((end - start) / tick)
        moved = _advance(model, profile, start, end, y, count)
        if moved is None:
            break
        result[row] = y = moved
    return result


def _constant(torque: Sequence[float]) -> Profile:
    first, second, third = torque
    return lambda _: (first, second, third)


def _advance(
    model: kernel.Model, torque: Profile, start_ns: int, end_ns: int, y: Vector, steps: int
) -> Vector | None:
    """Integrate from start to end; None where the motion has no finite continuation."""

    def rates(t: float, y: Vector) -> kernel.State:
        return kernel.derivative(model, y, torque(t))

    start, h = start_ns / NANOSECONDS, (end_ns - start_ns) / NANOSECONDS / steps
    try:
        for step in range(steps):
            y = METHOD.step(rates, start + step * h, y, h).y
    except (ArithmeticError, ValueError):
        return None
    return y if all(map(math.isfinite, y)) else None
