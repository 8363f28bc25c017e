# SPDX-License-Identifier: Apache-2.0
"""Integration error of a recorded run: its states against a reference integrated anew.

The reference is propagated by DOP853 with a tight tolerance, two or more steps a tick. Its distance
from a coarse solution of steps twice as long bounds its own error. Long runs are compiled; without
numba only their first minute or so is compared, and `Comparison.reasons` reports that.

Actuators that lag are part of the state, and torques are held to the scene's limit. A moment from a
topic must be recorded; without it there is nothing to compare with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sst_ros.extras import require
from sst_ros.host.output import Bar
from sst_ros.integration.propagator import LONGEST_TICK_NS, TickPropagator, TickSequence
from sst_ros.mechanism.frames import angle_between
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.report import states
from sst_ros.report.states import CHUNK, COMPILED_FROM, PLAIN_TICKS, ticks_of
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame

QUANTITIES = ("gamma", "gamma_dot", "orientation")


class Comparison(NamedTuple):
    """A recording against a reference.

    Attributes:
        error: distance of the recording from the reference, a row a sample, nan where there is
            none: gamma and gamma_dot, the largest difference of the actuator angles [rad] and rates
            [rad/s]; orientation, the angle between the orientations of {E} [rad].
        own: the reference's own error, in the same columns.
        restarts_ns: instants at which the reference had to begin again from a recorded sample,
            because torques before it were lost [ns].
        steps: least number of steps a tick of the reference.
        reasons: why samples are not compared; empty where all are, or only torques are missing.

    """

    error: DataFrame
    own: DataFrame
    restarts_ns: tuple[int, ...] = ()
    steps: int = 0
    reasons: tuple[str, ...] = ()

    @property
    def compared(self) -> int:
        """Number of samples that were compared."""
        return int(self.error.gamma.count())


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
        return Comparison(_unknown(recording), _unknown(recording), reasons=(reason,))
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
    error, own = _unknown(recording), _unknown(recording)
    reasons, restarts, count = [], [], len(ticks.start_ns)
    tick_ns = recording.ticks.period_ns
    if not motion.compiled:
        longest = PLAIN_TICKS * tick_ns // np.median(ticks.end_ns - ticks.start_ns)
        count = min(count, int(longest))
    if count < len(ticks.start_ns):
        until = ticks.end_ns[count - 1] / NANOSECONDS
        reasons.append(f"only the first {until:g} s are compared: there is no numba for more")

    def note(rows: Integers, reached: Array) -> None:
        """Write down how far samples are from the solution, and the coarse one, (n, 2, m)."""
        fine, coarse = (states.outputs(motion.dynamics.model, reached[:, i]) for i in range(2))
        sampled = recording.quaternion[rows], recording.gamma[rows], recording.gamma_dot[rows]
        error.iloc[rows], own.iloc[rows] = _measure(sampled, fine), _measure(coarse, fine)

    if start is not None:
        note(np.array([0]), np.array([[start, start]]))
        if ticks.start_ns[0] != 0:
            start = None
    gaps = 1 + np.flatnonzero(ticks.start_ns[1:] != ticks.end_ns[:-1])
    ends = np.append(gaps[gaps < count], count)
    bar, first = Bar("reference", count > CHUNK), 0
    while first < count:
        if start is None:
            again = _find_restart(recording, ticks, first, count) if restart else None
            if again is None:
                break
            first, start = again
            restarts.append(int(ticks.start_ns[first]))
        end = int(ends[np.searchsorted(ends, first, side="right")])
        some = ticks.part(slice(first, min(first + CHUNK, end)))
        starts = np.full((len(some.start_ns), len(start)), np.nan)
        starts[0] = start
        reached = motion.follow(some, starts)[..., :-1]
        done = int(np.isfinite(reached[:, 0, 0]).sum())
        rows = places(recording.time_ns, some.end_ns[:done])
        note(rows[rows >= 0], reached[:done][rows >= 0])
        whole = done == len(starts)  # else no step resolves the next tick
        first += done if whole else done + 1
        start = tuple(reached[-1, 0].tolist()) if whole and first < end else None
        bar.draw(min(first / count, 1.0))
    error[np.isin(recording.time_ns, restarts)] = np.nan
    steps = 2 * -(-tick_ns // LONGEST_TICK_NS)
    return Comparison(error, own, tuple(restarts), steps, tuple(reasons))


def _unknown(recording: Recording) -> DataFrame:
    """Return the errors of samples of which none is compared yet."""
    count = len(recording.time_ns)
    table: DataFrame = require("pandas").DataFrame(np.full((count, 3), np.nan), columns=QUANTITIES)
    return table


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


def _measure(one: Sequence[Array], other: Sequence[Array]) -> Array:
    """Distances of quaternions, gamma and gamma_dot, in the columns QUANTITIES, shape (n, 3)."""
    # Recorded angles may count whole turns, computed ones do not.
    turn, difference = 2.0 * np.pi, one[1] - other[1]
    gamma = np.abs(difference - turn * np.round(difference / turn)).max(axis=1)
    rate = np.abs(one[2] - other[2]).max(axis=1)
    return np.stack([gamma, rate, angle_between(one[0], other[0])], axis=1)
