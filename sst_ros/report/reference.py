# SPDX-License-Identifier: Apache-2.0
"""How far a recorded run is from the solution: the run, integrated again, at high accuracy.

The method is DOP853 with two or more steps a tick, on the kernel's equations; nothing of
`Simulation` takes part. Every comparison integrates twice, with different step sizes; the
difference of the two is the reference's own error. Long runs are compiled; where there is no numba
only their first minute or so is compared, and `Comparison.reasons` says so.

Actuators that lag are part of the state, and torques are held to the scene's limit. Impacts are
not solved a second time: after one, the reference begins again at the next recorded sample. A
moment from a topic must be recorded; without it there is nothing to compare with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.progress import slices
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS, Integers, places
from sst_ros.report import states
from sst_ros.report.fixed_step_motion import COMPILED_FROM, Course, Motion, held
from sst_ros.report.states import Vector

LONGEST_STEP_NS, LONGEST_IDEAL_STEP_NS = 500_000, 1_000_000
"""The coarse steps of the reference are not longer than this [ns]. What hold and transport cost is
larger than what an integrator gets wrong, and can be told with longer steps."""

PLAIN_TICKS = 60_000
"""So many ticks are compared in plain Python, a minute's work."""

CHUNK = 25_000
"""So many ticks at a time, which bounds the memory."""


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

    @classmethod
    def none(cls, count: int) -> Deviation:
        """Nothing to say about `count` samples."""
        return cls(*np.full((3, count), np.nan))


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
    begun = states.begins(recording)
    start = states.initial(recording.scene) if begun else None
    course, moment = held(recording), recording.scene.moment
    if moment is not None and moment.topic and recording.ticks.moment is None:
        count = len(recording.time_ns)
        reason = "the moment on the star came from a topic and is not recorded: nothing is compared"
        return Comparison(Deviation.none(count), Deviation.none(count), (), 0, (reason,))
    motion = Motion(recording.scene, None, compiled=len(course.start_ns) > COMPILED_FROM)
    return _compare(recording, motion, course, start, LONGEST_STEP_NS, again=True)


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
    time = recording.time_ns
    course = Course(time[:-1], time[1:], np.empty((len(time) - 1, 0)))
    many = len(recording.ticks.start_ns) > COMPILED_FROM
    motion = Motion(recording.scene, torque, compiled=many)
    start = states.initial(recording.scene)
    return _compare(recording, motion, course, start, LONGEST_IDEAL_STEP_NS, again=False)


def _compare(
    recording: Recording,
    motion: Motion,
    course: Course,
    start: Vector | None,
    longest_ns: int,
    *,
    again: bool,
) -> Comparison:
    """Go through a course twice, in fine and in coarse steps, and compare at the samples.

    Args:
        recording: what is compared.
        motion: how it moves.
        course: the ticks.
        start: state at time zero; None where it is not known.
        longest_ns: longest coarse step [ns].
        again: begin again at a sample where the way was lost.

    """
    tick = recording.ticks.period_ns
    coarse = math.ceil(tick / longest_ns)
    fine = max(coarse + 1, math.ceil(1.5 * coarse))
    time, geometry = recording.time_ns, Geometry.of(recording.scene)
    breaks = 1 + np.flatnonzero(course.start_ns[1:] != course.end_ns[:-1])
    error, own = Deviation.none(len(time)), Deviation.none(len(time))
    restarts: list[int] = []
    impacts = clock = 0
    now: list[Vector] = []
    if start is not None:
        now = [start, start]
        _note(error, own, recording, motion, np.array([0]), [np.array([start])] * 2)
    total = len(course.start_ns)
    plain = int(PLAIN_TICKS * tick // np.median(course.end_ns - course.start_ns))
    judged = total if motion.compiled else min(total, plain)
    for part in slices(judged, CHUNK, "reference", shown=again and total > CHUNK):
        here = course.part(part)
        at_end, at_start = places(time, here.end_ns), places(time, here.start_ns)
        anew = np.flatnonzero((at_start >= 0) & np.isfinite(recording.quaternion[at_start, 0]))
        ticks_in = np.ceil((here.end_ns - here.start_ns) / tick).astype(np.int64)
        k, count = 0, len(at_end)
        while k < count:
            if clock != here.start_ns[k]:
                now = []
            if not now:
                next_start = int(np.searchsorted(anew, k))
                if not again or next_start == len(anew):
                    break
                k = int(anew[next_start])
                now = [tuple(states.recorded(geometry, recording, [int(at_start[k])])[0])] * 2
                restarts.append(int(here.start_ns[k]))
            after = int(np.searchsorted(breaks, part.start + k, side="right"))
            stop = min(count, int(breaks[after]) - part.start if after < len(breaks) else count)
            (first, hit), (second, hit_too) = (
                motion.follow(y, here.part(slice(k, stop)), ticks_in[k:stop] * steps)
                for y, steps in zip(now, (fine, coarse), strict=True)
            )
            done = min(len(first), len(second))
            rows = at_end[k : k + done]
            reached = [way[:done][rows >= 0] for way in (first, second)]
            _note(error, own, recording, motion, rows[rows >= 0], reached)
            if k + done < stop:
                # Of two ways one may meet an impact at the end of a tick, the other in the next.
                impacts += hit or hit_too
                now = []
                k += done + 1 + (abs(len(first) - len(second)) == 1)
            else:
                now = [tuple(way[-1].tolist()) for way in (first, second)]
                k, clock = stop, int(here.end_ns[stop - 1])
    reasons = []
    if impacts:
        reasons.append(f"{impacts} impacts: the reference begins again after each")
    if judged < total:
        until = course.end_ns[judged - 1] / NANOSECONDS
        reasons.append(f"only the first {until:g} s are compared: there is no numba for more")
    for values in (error.gamma, error.gamma_dot, error.orientation):
        values[np.isin(time, restarts)] = np.nan
    return Comparison(error, own, tuple(restarts), fine, tuple(reasons))


def _note(
    error: Deviation,
    own: Deviation,
    recording: Recording,
    motion: Motion,
    rows: Integers,
    reached: list[Array],
) -> None:
    """Write down how far samples are from the states that were reached finely and coarsely."""
    fine, coarse = (states.outputs(motion.dynamics, way) for way in reached)
    sampled = recording.quaternion[rows], recording.gamma[rows], recording.gamma_dot[rows]
    for deviation, one in ((error, sampled), (own, coarse)):
        found = _deviation(one, fine)
        deviation.gamma[rows], deviation.gamma_dot[rows] = found.gamma, found.gamma_dot
        deviation.orientation[rows] = found.orientation


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
