# SPDX-License-Identifier: Apache-2.0
"""Integration error of a recorded run: its states against a reference integrated anew.

The reference is propagated by DOP853 with a tight tolerance, two or more steps a tick. Its distance
from a coarse solution of steps twice as long bounds its own error. Long runs are compiled; without
numba only their first minute or so is compared, and `Comparison.reasons` reports that.

Actuators that lag are part of the state, and torques are held to the scene's limit. A moment from a
topic must be recorded; without it there is nothing to compare with.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.host.output import slices
from sst_ros.integration.propagator import LONGEST_TICK_NS, TickPropagator, TickSequence
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.report import states
from sst_ros.state import NANOSECONDS

COMPILED_FROM = 10_000
"""From this number of ticks on compilation costs less than it saves."""

PLAIN_TICKS = 60_000
"""So many ticks are compared in plain Python, a minute's work."""

CHUNK = 25_000
"""So many ticks at a time, which bounds the memory."""


@dataclass(frozen=True)
class Deviation:
    """Distance between two motions at each sample, shape (n,); nan where there is none.

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
        """No error at `count` samples."""
        return cls(*np.full((3, count), np.nan))


@dataclass(frozen=True)
class Comparison:
    """A recording against a reference.

    Attributes:
        error: recording against reference.
        own: the reference's own error.
        restarts_ns: instants at which the reference had to begin again from a recorded sample,
            because torques before it were lost [ns].
        steps: least number of steps a tick of the reference.
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
    """Compare with the exact motion under the recorded torques: the error of the integrator.

    A sample from which the reference restarts is not compared, and neither are samples between
    lost torques and the next restart.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    moment = recording.scene.moment
    if moment is not None and moment.topic and recording.ticks.moment is None:
        count = len(recording.time_ns)
        reason = "the moment on the star came from a topic and is not recorded: nothing is compared"
        return Comparison(Deviation.none(count), Deviation.none(count), (), 0, (reason,))
    start = states.initial(recording.scene) if states.begins(recording) else None
    ticks = ticks_of(recording)
    motion = TickPropagator(recording.scene, None, compiled=len(ticks.start_ns) > COMPILED_FROM)
    return _Reference(recording, motion, ticks).compare(start, restart=True)


def ideal(recording: Recording) -> Comparison | None:
    """Compare with the motion under continuous torques: the effect of hold and transport.

    None where the scene has no torques, its moment comes from a topic, or the recording lacks the
    start of the run.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    torque, moment = recording.scene.torque, recording.scene.moment
    if torque is None or (moment and moment.topic) or not states.begins(recording):
        return None
    time = recording.time_ns
    between = TickSequence(time[:-1], time[1:], np.empty((len(time) - 1, 0)))
    many = len(recording.ticks.start_ns) > COMPILED_FROM
    reference = _Reference(
        recording, TickPropagator(recording.scene, torque, compiled=many), between
    )
    return reference.compare(states.initial(recording.scene), restart=False)


def ticks_of(recording: Recording) -> TickSequence:
    """Return the recorded ticks."""
    ticks, torque = recording.ticks, recording.ticks.torque
    if Dynamics.of(recording.scene).has_moment_topic and ticks.moment is not None:
        torque = np.hstack([torque, ticks.moment])
    return TickSequence(ticks.start_ns, ticks.end_ns, torque)


class _Reference:
    """A run propagated with a coarse solution, compared at its samples.

    Args:
        recording: what is compared.
        motion: propagates it.
        ticks: what acts, tick by tick.

    """

    def __init__(self, recording: Recording, motion: TickPropagator, ticks: TickSequence) -> None:
        self._recording, self._motion, self._ticks = recording, motion, ticks
        self._tick_ns = recording.ticks.period_ns
        self._error, self._own = (Deviation.none(len(recording.time_ns)) for _ in range(2))

    def compare(self, start: tuple[float, ...] | None, *, restart: bool) -> Comparison:
        """Integrate and compare.

        Args:
            start: state at time zero; None where it is not known.
            restart: begin again at a recorded sample after lost torques; else the end is there.

        """
        ticks, time = self._ticks, self._recording.time_ns
        count = self._count()
        gaps = 1 + np.flatnonzero(ticks.start_ns[1:] != ticks.end_ns[:-1])
        bounds = [0, *gaps[gaps < count].tolist(), count]
        restarts: list[int] = []
        if start is not None:
            self._note(np.array([0]), np.array([[start, start]]))
            if ticks.start_ns[0] != 0:
                start = None
        for first, stop in itertools.pairwise(bounds):
            while first < stop:
                if start is None:
                    found = self._restart(first, stop) if restart else None
                    if found is None:
                        break
                    first, start = found
                    restarts.append(int(ticks.start_ns[first]))
                first = self._integrate(start, first, stop)
                start = None
        for values in (self._error.gamma, self._error.gamma_dot, self._error.orientation):
            values[np.isin(time, restarts)] = np.nan
        reasons = []
        if count < len(ticks.start_ns):
            until = ticks.end_ns[count - 1] / NANOSECONDS
            reasons.append(f"only the first {until:g} s are compared: there is no numba for more")
        steps = 2 * -(-self._tick_ns // LONGEST_TICK_NS)
        return Comparison(self._error, self._own, tuple(restarts), steps, tuple(reasons))

    def _count(self) -> int:
        """Return the number of ticks that are integrated."""
        ticks = self._ticks
        total = len(ticks.start_ns)
        if self._motion.compiled:
            return total
        return min(
            total, int(PLAIN_TICKS * self._tick_ns // np.median(ticks.end_ns - ticks.start_ns))
        )

    def _restart(self, first: int, stop: int) -> tuple[int, tuple[float, ...]] | None:
        """Find the next tick that begins at a sample, and the state of that sample."""
        recording = self._recording
        at = places(recording.time_ns, self._ticks.start_ns[first:stop])
        usable = np.flatnonzero((at >= 0) & np.isfinite(recording.quaternion[at, 0]))
        if not len(usable):
            return None
        tick = int(usable[0])
        geometry = Geometry.of(recording.scene)
        state = states.of_samples(geometry, recording, [int(at[tick])])[0]
        return first + tick, tuple(state.tolist())

    def _integrate(self, start: tuple[float, ...], first: int, stop: int) -> int:
        """Integrate ticks without gaps between them; return the first that was not reached."""
        state = np.array(start)
        for part in slices(stop - first, CHUNK, "reference", shown=stop - first > CHUNK):
            ticks = self._ticks.part(slice(first + part.start, first + part.stop))
            starts = np.full((len(ticks.start_ns), len(start)), np.nan)
            starts[0] = state
            reached = self._motion.follow(ticks, starts)[..., :-1]
            done = int(np.isfinite(reached[:, 0, 0]).sum())
            rows = places(self._recording.time_ns, ticks.end_ns[:done])
            self._note(rows[rows >= 0], reached[:done][rows >= 0])
            if done < len(starts):
                return int(first + part.start + done + 1)
            state = reached[-1, 0]
        return stop

    def _note(self, rows: Integers, reached: Array) -> None:
        """Write down how far samples are from the solution, and the coarse solution, (n, 2, m)."""
        recording, model = self._recording, self._motion.dynamics.model
        fine, coarse = (states.outputs(model, reached[:, i]) for i in range(2))
        sampled = recording.quaternion[rows], recording.gamma[rows], recording.gamma_dot[rows]
        for deviation, one in ((self._error, sampled), (self._own, coarse)):
            found = _deviation(one, fine)
            deviation.gamma[rows], deviation.gamma_dot[rows] = found.gamma, found.gamma_dot
            deviation.orientation[rows] = found.orientation


def _deviation(first: tuple[Array, Array, Array], second: tuple[Array, Array, Array]) -> Deviation:
    # Recorded angles may count whole turns, computed ones do not.
    turn = 2.0 * np.pi
    difference = first[1] - second[1]
    gamma = np.abs(difference - turn * np.round(difference / turn))
    return Deviation(
        gamma.max(axis=1),
        np.abs(first[2] - second[2]).max(axis=1),
        angle_between(first[0], second[0]),
    )
