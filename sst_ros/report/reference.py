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
from typing import NamedTuple

import numpy as np

from sst_ros.host.output import slices
from sst_ros.integration.propagator import LONGEST_TICK_NS, TickPropagator, TickSequence
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.report import states
from sst_ros.report.states import CHUNK, COMPILED_FROM, PLAIN_TICKS, ticks_of
from sst_ros.state import NANOSECONDS


class Deviation(NamedTuple):
    """Distance between two motions at each sample, shape (n,); nan where there is none.

    Attributes:
        gamma: largest difference of the actuator angles [rad].
        gamma_dot: largest difference of the actuator rates [rad/s].
        orientation: angle of the rotation between the orientations of {E} [rad].

    """

    gamma: Array
    gamma_dot: Array
    orientation: Array


class Comparison(NamedTuple):
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
    restarts_ns: tuple[int, ...] = ()
    steps: int = 0
    reasons: tuple[str, ...] = ()

    @classmethod
    def none(cls, recording: Recording) -> Comparison:
        """Return the comparison of a run in which nothing is compared yet."""
        unknown = np.full((2, 3, len(recording.time_ns)), np.nan)
        return cls(Deviation(*unknown[0]), Deviation(*unknown[1]))

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
        reason = "the moment on the star came from a topic and is not recorded: nothing is compared"
        return Comparison.none(recording)._replace(reasons=(reason,))
    start = states.initial(recording.scene) if states.begins(recording) else None
    ticks = ticks_of(recording)
    motion = TickPropagator(recording.scene, None, compiled=len(ticks.start_ns) > COMPILED_FROM)
    return _compare(recording, motion, ticks, start, restart=True)


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
    motion = TickPropagator(recording.scene, torque, compiled=many)
    return _compare(recording, motion, between, states.initial(recording.scene), restart=False)


def _compare(
    recording: Recording,
    motion: TickPropagator,
    ticks: TickSequence,
    start: tuple[float, ...] | None,
    *,
    restart: bool,
) -> Comparison:
    """Propagate a run with a coarse solution, and compare both at its samples.

    Args:
        recording: what is compared.
        motion: propagates it.
        ticks: what acts, tick by tick.
        start: state at time zero; None where it is not known.
        restart: begin again at a recorded sample after lost torques; else the end is there.

    """
    found, reasons, count = Comparison.none(recording), [], len(ticks.start_ns)
    tick_ns = recording.ticks.period_ns
    if not motion.compiled:
        longest = PLAIN_TICKS * tick_ns // np.median(ticks.end_ns - ticks.start_ns)
        count = min(count, int(longest))
    if count < len(ticks.start_ns):
        until = ticks.end_ns[count - 1] / NANOSECONDS
        reasons.append(f"only the first {until:g} s are compared: there is no numba for more")
    if start is not None:
        _note(found, recording, motion, np.array([0]), np.array([[start, start]]))
        if ticks.start_ns[0] != 0:
            start = None
    gaps = 1 + np.flatnonzero(ticks.start_ns[1:] != ticks.end_ns[:-1])
    restarts: list[int] = []
    for first, stop in itertools.pairwise([0, *gaps[gaps < count].tolist(), count]):
        while first < stop:
            if start is None:
                again = _find_restart(recording, ticks, first, stop) if restart else None
                if again is None:
                    break
                first, start = again
                restarts.append(int(ticks.start_ns[first]))
            for part in slices(stop - first, CHUNK, "reference", shown=stop - first > CHUNK):
                some = ticks.part(slice(first + part.start, first + part.stop))
                starts = np.full((len(some.start_ns), len(start)), np.nan)
                starts[0] = start
                reached = motion.follow(some, starts)[..., :-1]
                done = int(np.isfinite(reached[:, 0, 0]).sum())
                rows = places(recording.time_ns, some.end_ns[:done])
                _note(found, recording, motion, rows[rows >= 0], reached[:done][rows >= 0])
                if done < len(starts):  # no step resolves the next one
                    first += part.start + done + 1
                    break
                start = tuple(reached[-1, 0].tolist())
            else:
                first = stop
            start = None
    for values in found.error:
        values[np.isin(recording.time_ns, restarts)] = np.nan
    steps = 2 * -(-tick_ns // LONGEST_TICK_NS)
    return Comparison(found.error, found.own, tuple(restarts), steps, tuple(reasons))


def _find_restart(
    recording: Recording, ticks: TickSequence, first: int, stop: int
) -> tuple[int, tuple[float, ...]] | None:
    """Find the next tick that begins at a sample, and the state of that sample."""
    at = places(recording.time_ns, ticks.start_ns[first:stop])
    usable = np.flatnonzero((at >= 0) & np.isfinite(recording.quaternion[at, 0]))
    if not len(usable):
        return None
    tick = int(usable[0])
    state = states.of_samples(Geometry.of(recording.scene), recording, [int(at[tick])])[0]
    return first + tick, tuple(state.tolist())


def _note(
    found: Comparison, recording: Recording, motion: TickPropagator, rows: Integers, reached: Array
) -> None:
    """Write down how far samples are from the solution, and the coarse solution, (n, 2, m)."""
    fine, coarse = (states.outputs(motion.dynamics.model, reached[:, i]) for i in range(2))
    sampled = recording.quaternion[rows], recording.gamma[rows], recording.gamma_dot[rows]
    for deviation, one in ((found.error, sampled), (found.own, coarse)):
        # Recorded angles may count whole turns, computed ones do not.
        turn, difference = 2.0 * np.pi, one[1] - fine[1]
        gamma = np.abs(difference - turn * np.round(difference / turn))
        deviation.gamma[rows] = gamma.max(axis=1)
        deviation.gamma_dot[rows] = np.abs(one[2] - fine[2]).max(axis=1)
        deviation.orientation[rows] = angle_between(one[0], fine[0])
