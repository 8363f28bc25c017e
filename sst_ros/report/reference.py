# SPDX-License-Identifier: Apache-2.0
"""How far a recorded run is from the solution: the run, integrated again, at high accuracy.

The method is DOP853 with two or more steps a tick, on the kernel's equations; nothing of
`Simulation` takes part. Every comparison integrates twice, with different step sizes; the
difference of the two is the reference's own error.

Actuators that lag are part of the state, and torques are held to the scene's limit. Impacts are
not solved a second time: after one, the reference begins again at the next recorded sample. A
moment from a topic must be recorded; without it there is nothing to compare with.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sst_ros.control.torque import Profile, sine
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.report import states
from sst_ros.report.motion import Motion
from sst_ros.report.recording import Recording
from sst_ros.report.states import Vector

LONGEST_STEP_NS = 500_000
"""Steps of the reference are not longer than this [ns]."""


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
            because torques before it were lost, or after an impact [ns].
        steps: steps a tick of the reference.
        reasons: why samples are not compared; empty where all are, or only torques are missing.

    """

    error: Deviation
    own: Deviation
    restarts_ns: tuple[int, ...]
    steps: int
    reasons: tuple[str, ...] = ()

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(np.count_nonzero(np.isfinite(self.error.gamma)))


def integration(recording: Recording) -> Comparison:
    """Compare with the exact motion under the recorded torques: what the integrator got wrong.

    A sample from which the reference begins again is not compared, and neither are samples
    between lost torques, or an impact, and the next beginning.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    return _compare(recording, lambda motion, steps: _held(recording, motion, steps))


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under the scene's continuous torques: what hold and transport cost.

    None where the scene has no torques, its moment comes from a topic, or the recording lacks the
    start of the run. The comparison ends at the first impact.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    torque = recording.scene.torque
    moment = recording.scene.moment
    if torque is None or (moment and moment.topic) or not states.begins(recording):
        return None
    profile = sine(torque)
    return _compare(recording, lambda motion, steps: (_free(recording, motion, profile, steps), ()))


def _compare(
    recording: Recording, solve: Callable[[Motion, int], tuple[Array, tuple[int, ...]]]
) -> Comparison:
    motion = Motion(recording.scene)
    model = motion.model
    coarse = max(2, math.ceil(recording.ticks.period_ns / LONGEST_STEP_NS))
    fine = math.ceil(1.5 * coarse)
    rough = states.outputs(model, solve(motion, coarse)[0])
    solved, restarts = solve(motion, fine)
    reference = states.outputs(model, solved)
    sampled = (recording.quaternion, recording.gamma, recording.gamma_dot)
    error = _deviation(sampled, reference)
    for values in (error.gamma, error.gamma_dot, error.orientation):
        values[np.isin(recording.time_ns, restarts)] = np.nan
    own = _deviation(rough, reference)
    return Comparison(error, own, restarts, fine, tuple(_reasons(recording, motion)))


def _reasons(recording: Recording, motion: Motion) -> Iterator[str]:
    if motion.impacts:
        yield f"{motion.impacts} impacts: the reference begins again after each"
    if _unknown_moment(recording):
        yield "the moment on the star came from a topic and is not recorded: nothing is compared"


def _unknown_moment(recording: Recording) -> bool:
    moment = recording.scene.moment
    return moment is not None and moment.topic and recording.ticks.moment is None


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


def _held(recording: Recording, motion: Motion, steps: int) -> tuple[Array, tuple[int, ...]]:
    """States at the samples, one a row, under the recorded torques, and the restarts [ns]."""
    result = np.full((len(recording.time_ns), motion.size), np.nan)
    sample_at = {int(time): row for row, time in enumerate(recording.time_ns)}
    geometry = Geometry.of(recording.scene)
    restarts: list[int] = []
    motion.impacts = now = 0
    y: Vector | None = None
    if _unknown_moment(recording):
        return result, ()
    if states.begins(recording):
        y = states.initial(recording.scene)
        result[0] = y
    ticks = recording.ticks
    moments = [None] * len(ticks.start_ns) if ticks.moment is None else ticks.moment.tolist()
    for start, end, row, moment in zip(
        ticks.start_ns.tolist(), ticks.end_ns.tolist(), ticks.torque.tolist(), moments, strict=True
    ):
        if y is None or now != start:
            sample = sample_at.get(start)
            y = None if sample is None else states.recorded(geometry, recording, sample)
            if y is None:
                continue
            restarts.append(start)
        y = motion.advance(_constant(row), moment, start, end, y, steps)
        now = end
        if y is not None and end in sample_at:
            result[sample_at[end]] = y
    return result, tuple(restarts)


def _free(recording: Recording, motion: Motion, profile: Profile, steps: int) -> Array:
    """States at the samples, one a row, under a continuous torque."""
    times, tick = recording.time_ns.tolist(), recording.ticks.period_ns
    result = np.full((len(times), motion.size), np.nan)
    y = states.initial(recording.scene)
    result[0] = y
    motion.impacts = 0
    for row in range(1, len(times)):
        start, end = times[row - 1], times[row]
        count = steps * math.ceil((end - start) / tick)
        moved = motion.advance(profile, None, start, end, y, count)
        if moved is None:
            break
        result[row] = y = moved
    return result


def _constant(torque: Sequence[float]) -> Profile:
    first, second, third = torque
    return lambda _: (first, second, third)
