# SPDX-License-Identifier: Apache-2.0
"""How regular a recorded run was: periods, lost samples, missed ticks, pace, commands.

Periods are between the receptions of consecutive samples by the recorder, so that they hold the
jitter of simulator, transport and recorder together.

A command is paired with the first tick that applies its values. Two delays are measured:

- By the recorder's clock, from the reception of the command to the step. The simulator begins the
  step of a tick when the tick ends, with the newest command that it has; when that was is read from
  the receptions of the samples, at the tick's end between two of them. This holds at any pace and
  with any clock in the stamps, and includes the transport of the samples to the recorder.
- By stamps, from that of a command, which is that of the sample it answers, to the beginning of the
  tick: simulated time between what was measured and what was done about it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sst_ros.recording.recording import Recording
from sst_ros.state import NANOSECONDS, Array

if TYPE_CHECKING:
    from pandas import DataFrame, Series

REPORTED = (
    *("ticks_missed", "ticks", "step_mean_us"),
    *("error_estimate", "hold_error_start", "hold_error_middle"),
)
"""Numbers of the diagnostics that are shown over the run."""

STATISTICS = {"min": "min", "mean": "mean", "99%": "p99", "99.9%": "p99_9", "max": "max"}
"""What is shown of periods and delays, as pandas and as the summary name it."""


class Timing(NamedTuple):
    """Timing of a recording by its clocks."""

    period_us: Array  # between receptions of samples that follow each other [us], shape (p,)
    lost_s: Array  # times of lost samples [s], shape (l,)
    gaps_s: Array  # times at which a tick does not begin where the one before ended [s]
    pace: Series[float]  # simulated time per time on the recorder's clock, over time [s]
    reported: DataFrame
    """A row for each of the simulator's reports: time_s of the run, and the numbers of REPORTED,
    nan where one was not reported."""
    commands: DataFrame
    """A row for each command that was followed: time_s, when the tick begins that applied it;
    received_us, from its reception to the step; stamped_us, from its stamp to the beginning of the
    tick, nan where it has none; tick, its number."""
    numbers: dict[str, Any]  # all in all: flat, units in the names, None for what is not known
    missing: list[str]  # what is not known, and why


def measure(recording: Recording) -> Timing:
    """Measure a recording."""
    time, received_ns, ticks = recording.time_ns, recording.received_ns, recording.ticks
    spacing, period, missing = np.diff(time), recording.period_ns, list[str]()
    period_us = np.diff(received_ns)[spacing == period] / 1e3
    if np.any(period_us < 0.0):
        missing.append("receptions are not in the order of the samples: periods are as recorded")
    lost_ns = [
        time[row] + period * np.arange(1, round(spacing[row] / period))
        for row in np.flatnonzero(spacing > period).tolist()
    ]
    # Simulated time per received time, over pieces of the run.
    rows = np.unique(np.linspace(0, len(time) - 1, min(61, len(time))).round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(time[rows]) / np.diff(received_ns[rows])
    middle = 0.5 * (time[rows][1:] + time[rows][:-1]) / NANOSECONDS
    good = np.isfinite(pace) & (pace > 0.0)
    if not recording.diagnostics:
        missing.append("no diagnostics: missed ticks and samples published are not known")
    commands = pair_commands(recording)
    if not len(recording.commands.torque):
        missing.append("no commands are recorded: their latency is not known")
    elif commands.empty:
        missing.append("no recorded command is found among the applied torques")
    first = int(received_ns[0])
    reports = [values for _, values in recording.reports]
    reported = pd.DataFrame(reports, columns=REPORTED).replace("", None).astype(float)
    at, since = [when_ns - first for when_ns, _ in recording.reports], received_ns - first
    reported.insert(0, "time_s", np.interp(at, since.astype(float), recording.seconds))
    delays = {
        "period": pd.Series(period_us, dtype=float),
        "command_latency": commands.received_us,
        "command_stamp_to_tick": commands.stamped_us,
    }
    numbers = {"commands_followed": len(commands), **_measure_answers(recording, commands)}
    for name, values in delays.items():
        described = values.describe([0.99, 0.999]).dropna()
        numbers |= {f"{name}_{word}_us": described.get(key) for key, word in STATISTICS.items()}
    return Timing(
        period_us=period_us,
        lost_s=np.concatenate([np.empty(0), *lost_ns]) / NANOSECONDS,
        gaps_s=ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]] / NANOSECONDS,
        pace=pd.Series(pace[good], middle[good]),
        reported=reported,
        commands=commands,
        numbers=numbers,
        missing=missing,
    )


def pair_commands(recording: Recording) -> DataFrame:
    """Pair commands with ticks, by their values: `Timing.commands`.

    Each has the first tick of its values from its reception on, or from a tick before it: the
    recorder may have received it a little later than the simulator.
    """
    legs, commands, ticks = ["1", "2", "3"], recording.commands, recording.ticks
    limit = recording.scene.torque_limit
    most = np.inf if limit is None else limit
    asked, applied = (np.clip(each.torque, -most, most) + 0.0 for each in (commands, ticks))
    new, changed = _changes(asked), _changes(applied)
    # When the steps of ticks began, interpolated between the receptions of samples.
    first = recording.received_ns[0]
    since = (recording.received_ns - first).astype(float)
    step_ns = first + np.interp(ticks.end_ns, recording.time_ns, since).astype(np.int64)
    left = pd.DataFrame(asked[new], columns=legs)
    left = left.assign(command=new, ns=commands.received_ns[new] - ticks.period_ns)
    right = pd.DataFrame(applied[changed], columns=legs)
    right = right.assign(tick=changed, ns=step_ns[changed])
    left, right = (table.sort_values("ns", kind="stable") for table in (left, right))
    found = pd.merge_asof(left, right, on="ns", by=legs, direction="forward")
    # Commands are in order of reception: the last of those that share a tick is the one it took.
    found = found.dropna(subset="tick").sort_values("command").drop_duplicates("tick", keep="last")
    command, tick = (found[name].to_numpy(dtype=int) for name in ("command", "tick"))
    stamps, begins = commands.stamp_ns[command], ticks.start_ns[tick]
    age = (begins + recording.start_ns - stamps) / 1e3
    received = (step_ns[tick] - commands.received_ns[command]) / 1e3
    stamped, seconds = np.where(stamps > 0, age, np.nan), begins / NANOSECONDS
    columns = {"time_s": seconds, "received_us": received, "stamped_us": stamped, "tick": tick}
    return pd.DataFrame(columns)


def _changes(torque: Array) -> NDArray[np.intp]:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero((np.diff(torque, axis=0, prepend=np.nan) != 0.0).any(axis=1))


def _measure_answers(recording: Recording, paired: DataFrame) -> dict[str, float | None]:
    """Share of samples that a command answered, and the mean age [s] of the command of a tick."""
    commands, start_ns = recording.commands, recording.ticks.start_ns
    share = age = None
    if len(paired) > 1:  # a torque that is commanded once and for all answers no samples
        if commands.stamp_ns.any():
            answered = np.isin(recording.time_ns + recording.start_ns, commands.stamp_ns)
        else:
            counts = np.searchsorted(commands.received_ns, recording.received_ns, side="left")
            answered = np.append(np.diff(counts), 0) > 0
        # The last sample is the end of the run, which nothing answers.
        share = 100.0 * float(np.mean(answered[:-1]))
        begins = np.sort(start_ns[paired.tick])
        tick = np.searchsorted(begins, start_ns, side="right") - 1
        held = start_ns[tick >= 0] - begins[tick[tick >= 0]]
        age = float(held.mean() / NANOSECONDS) if len(held) else 0.0
    return {"samples_answered_percent": share, "command_age_mean_s": age}
