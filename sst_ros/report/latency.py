# SPDX-License-Identifier: Apache-2.0
"""How long commands take: from a command to the step that applies it.

A command is paired with the first tick that applies its values. Two delays are measured:

- By the recorder's clock, from the reception of the command to the step. The simulator begins the
  step of a tick when the tick ends, with the newest command that it has; when that was is read from
  the receptions of the samples, at the tick's end between two of them. This holds at any pace and
  with any clock in the stamps, and includes the transport of the samples to the recorder.
- By stamps, from that of a command, which is that of the sample it answers, to the beginning of the
  tick: simulated time between what was measured and what was done about it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS, Integers


class Latency(NamedTuple):
    """Delays of commands that were followed.

    Attributes:
        time_s: beginning of the ticks that applied them [s], shape (f,).
        received_us: from the reception of the command to the step [us], shape (f,).
        stamped_us: from the stamp of the command to the beginning of the tick [us], shape (f,);
            nan where commands have no stamp.
        answered: share of the samples after which a new command was received, None without any.
        age_s: mean time for which ticks have held their command [s], None without any.

    """

    time_s: Array
    received_us: Array
    stamped_us: Array
    answered: float | None = None
    age_s: float | None = None


def latency(recording: Recording, missing: list[str]) -> Latency:
    """Pair commands with ticks, by their values; `missing` gets a line where there are none."""
    commands, ticks = recording.commands, recording.ticks
    if not len(commands.torque):
        missing.append("no commands are recorded: their latency is not known")
        return Latency(*np.empty((3, 0)))
    limit = recording.scene.actuators.torque_limit if recording.scene.actuators else None
    asked, applied = _digest(commands.torque, limit), _digest(ticks.torque, limit)
    new, changed = _changes(asked), _changes(applied)
    step_ns = _received(recording, ticks.end_ns[changed])
    # The recorder may have received a command a little later than the simulator.
    earliest_ns = commands.received_ns[new] - ticks.period_ns
    command, tick = _pairs(asked[new], earliest_ns, applied[changed], step_ns)
    if not len(command):
        missing.append("no recorded command is found among the applied torques")
        return Latency(*np.empty((3, 0)))
    stamps = commands.stamp_ns[new][command]
    begins = ticks.start_ns[changed][tick]
    answered = np.where(stamps > 0, (begins + recording.start_ns - stamps) / 1e3, np.nan)
    passed = (step_ns[tick] - commands.received_ns[new][command]) / 1e3
    # A torque that is commanded once and for all answers no samples.
    share, age = _answered(recording, begins) if len(begins) > 1 else (None, None)
    return Latency(begins / NANOSECONDS, passed, answered, share, age)


def _answered(recording: Recording, begins: Integers) -> tuple[float, float]:
    """Share of samples that a command answered, and the mean age [s] of the command of a tick."""
    received, commands = recording.received_ns, recording.commands
    if commands.stamp_ns.any():
        answered = np.isin(recording.time_ns + recording.start_ns, commands.stamp_ns)
    else:
        counts = np.searchsorted(commands.received_ns, received, side="left")
        answered = np.append(np.diff(counts), 0) > 0
    ticks = np.searchsorted(begins, recording.ticks.start_ns, side="right") - 1
    held = recording.ticks.start_ns[ticks >= 0] - np.sort(begins)[ticks[ticks >= 0]]
    # The last sample is the end of the run, which nothing answers.
    share = float(np.mean(answered[:-1]))
    return share, float(held.mean() / NANOSECONDS) if len(held) else 0.0


def _received(recording: Recording, time_ns: Integers) -> Integers:
    """Return when times of the run were received [ns], interpolated between samples."""
    first = recording.received_ns[0]
    since = (recording.received_ns - first).astype(float)
    return np.asarray(first + np.interp(time_ns, recording.time_ns, since).astype(np.int64))


def _changes(digest: Integers) -> Integers:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero(np.diff(digest, prepend=~digest[:1]))


def _digest(torque: Array, limit: float | None) -> Integers:
    """One number for three: equal for equal torques within the limit, hardly ever for others."""
    digest = np.zeros(len(torque), dtype=np.uint64)
    for column in torque.T:
        held = column if limit is None else np.clip(column, -limit, limit)
        digest ^= (held + 0.0).view(np.uint64)  # -0.0 becomes 0.0
        digest *= np.uint64(0x9E3779B97F4A7C15)
        digest ^= digest >> np.uint64(29)
    return digest.view(np.int64)


def _pairs(
    asked: Integers, earliest_ns: Integers, applied: Integers, applied_ns: Integers
) -> tuple[Integers, Integers]:
    """Find for each command the first tick of its values from `earliest` on."""
    _, kinds = np.unique(np.concatenate([asked, applied]), return_inverse=True)
    asked_kind, applied_kind = kinds[: len(asked)], kinds[len(asked) :]
    order = np.lexsort((applied_ns, applied_kind))
    # One ascending number of kind and time, so that one search finds the tick of the kind.
    start = min(int(earliest_ns.min()), int(applied_ns.min()))
    span = max(int(earliest_ns.max()), int(applied_ns.max())) + 1 - start
    keys = 2.0 * applied_kind[order] + (applied_ns[order] - start) / span
    wanted = 2.0 * asked_kind + (earliest_ns - start) / span
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    found = order[at]
    good = (keys[at] >= wanted) & (applied_kind[found] == asked_kind)
    command, tick = np.flatnonzero(good), found[good]
    # Commands are in order of reception: the last of those that share a tick is the one it took.
    last = len(tick) - 1 - np.unique(tick[::-1], return_index=True)[1]
    last.sort()
    return command[last], tick[last]
