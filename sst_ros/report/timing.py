# SPDX-License-Identifier: Apache-2.0
"""How regular a recorded run was: periods, lost samples, missed ticks, pace, commands, energy.

Periods are between the receptions of consecutive samples by the recorder, so that they hold the
jitter of simulator, transport and recorder together.

A command is paired with the first tick that applies its values. Two delays are measured:

- By the recorder's clock, from the reception of the command to the step. The simulator begins the
  step of a tick when the tick ends, with the newest command that it has; when that was is read from
  the receptions of the samples, at the tick's end between two of them. This holds at any pace and
  with any clock in the stamps, and includes the transport of the samples to the recorder.
- By stamps, from that of a command, which is that of the sample it answers, to the beginning of the
  tick: simulated time between what was measured and what was done about it.

The balance of energy is what the samples have, less the work put in between.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.extras import require
from sst_ros.host import compiled_module
from sst_ros.host.output import slices
from sst_ros.integration.propagator import TickPropagator, TickSequence
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers, places
from sst_ros.report.reference import CHUNK, COMPILED_FROM, PLAIN_TICKS, of_samples, ticks_of
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame, Series

REPORTED = (
    *("ticks_missed", "ticks", "step_mean_us"),
    *("error_estimate", "hold_error_start", "hold_error_middle"),
)
"""Numbers of the diagnostics that are shown over the run."""

STATISTICS: dict[str, Callable[[Array], Any]] = {
    "min": np.min,
    "mean": np.mean,
    "p99": lambda values: np.percentile(values, 99.0),
    "p99_9": lambda values: np.percentile(values, 99.9),
    "max": np.max,
}


class Timing(NamedTuple):
    """Timing of a recording by its clocks, and its energy balance.

    Attributes:
        samples: a row a sample: time_s; late_us, how much later it was received than the fastest
            one, by its stamp, which grows where the simulator falls behind; energy_J, energy
            balance residual since the start, nan where it is not known.
        period_us: time between receptions of samples that follow each other [us], shape (p,).
        nominal_us: what it should be [us].
        lost_s: times of lost samples [s], shape (l,).
        gaps_s: times at which a tick does not begin where the one before ended [s].
        pace: simulated time per time on the recorder's clock, over time [s].
        reported: a row for each of the simulator's reports: time_s of the run, and the numbers
            of REPORTED, nan where one was not reported.
        commands: a row for each command that was followed: time_s, when the tick begins that
            applied it; received_us, from its reception to the step; stamped_us, from its stamp to
            the beginning of the tick, nan where it has none.
        answers: samples_answered_percent, the share of the samples after which a new command was
            received, and command_age_mean_s, for which ticks have held theirs; None without any.
        missing: what is not known, and why.

    """

    samples: DataFrame
    period_us: Array
    nominal_us: float
    lost_s: Array
    gaps_s: Array
    pace: Series[float]
    reported: DataFrame
    commands: DataFrame
    answers: dict[str, float | None]
    missing: tuple[str, ...]

    def numbers(self) -> dict[str, Any]:
        """Sum it up: flat, units in the names, None for what is not known."""
        energy = self.samples.energy_J.abs().max()
        delays = {
            "period": self.period_us,
            "command_latency": self.commands.received_us.to_numpy(),
            "command_stamp_to_tick": self.commands.stamped_us.dropna().to_numpy(),
        }
        return {
            **{
                f"{name}_{word}_us": float(function(values)) if len(values) else None
                for name, values in delays.items()
                for word, function in STATISTICS.items()
            },
            "commands_followed": len(self.commands),
            **self.answers,
            "energy_residual_max_J": float(energy) if energy >= 0.0 else None,
            "unknown": list(self.missing),
        }


def measure(recording: Recording) -> Timing:
    """Measure a recording."""
    pandas, missing = require("pandas"), []
    time, received_ns, ticks = recording.time_ns, recording.received_ns, recording.ticks
    spacing, period = np.diff(time), recording.period_ns
    period_us = np.diff(received_ns)[spacing == period] / 1e3
    if np.any(period_us < 0.0):
        missing.append("receptions are not in the order of the samples: periods are as recorded")
    lost = [
        time[row] + period * np.arange(1, round(spacing[row] / period))
        for row in np.flatnonzero(spacing > period).tolist()
    ]
    # Simulated time per received time, over pieces of the run.
    pieces = min(60, len(time) - 1)
    rows = np.unique(np.linspace(0, len(time) - 1, pieces + 1).round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(time[rows]) / np.diff(received_ns[rows])
    middle = 0.5 * (time[rows][1:] + time[rows][:-1]) / NANOSECONDS
    good = np.isfinite(pace) & (pace > 0.0)
    if not recording.diagnostics:
        missing.append("no diagnostics: missed ticks and samples published are not known")
    commands, answers = pair_commands(recording, missing)
    late, energy = received_ns - time, energy_residual(recording, missing)
    samples = {"time_s": recording.seconds, "late_us": (late - late.min()) / 1e3}
    return Timing(
        samples=pandas.DataFrame(samples | {"energy_J": energy}),
        period_us=period_us,
        nominal_us=period / 1e3,
        lost_s=np.concatenate([np.empty(0), *lost]) / NANOSECONDS,
        gaps_s=ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]] / NANOSECONDS,
        pace=pandas.Series(pace[good], middle[good]),
        reported=_read_reports(recording),
        commands=commands,
        answers=answers,
        missing=tuple(missing),
    )


def _read_reports(recording: Recording) -> DataFrame:
    """Return times of the run [s] and the numbers of REPORTED, from the simulator's reports."""
    rows = [values for _, values in recording.reports]
    table: DataFrame = require("pandas").DataFrame(rows, columns=REPORTED)
    since = recording.received_ns - recording.received_ns[0]
    at = [received_ns - int(recording.received_ns[0]) for received_ns, _ in recording.reports]
    table.insert(0, "time_s", np.interp(at, since.astype(float), recording.seconds))
    return table.replace("", None).astype(float)


def pair_commands(
    recording: Recording, missing: list[str]
) -> tuple[DataFrame, dict[str, float | None]]:
    """Pair commands with ticks, by their values; `missing` gets a line where there are none.

    Returns:
        `Timing.commands` and `Timing.answers`.

    """
    commands, ticks = recording.commands, recording.ticks
    answers: dict[str, float | None] = dict.fromkeys(
        ("samples_answered_percent", "command_age_mean_s")
    )
    limit = recording.scene.torque_limit
    most = np.inf if limit is None else limit
    asked, applied = (np.clip(each.torque, -most, most) for each in (commands, ticks))
    new, changed = _changes(asked), _changes(applied)
    # When the steps of ticks began, interpolated between the receptions of samples.
    first = recording.received_ns[0]
    since = (recording.received_ns - first).astype(float)
    passed = np.interp(ticks.end_ns[changed], recording.time_ns, since)
    step_ns = first + passed.astype(np.int64)
    # The recorder may have received a command a little later than the simulator.
    earliest_ns = commands.received_ns[new] - ticks.period_ns
    command, tick = _pairs(asked[new], earliest_ns, applied[changed], step_ns)
    if not len(commands.torque):
        missing.append("no commands are recorded: their latency is not known")
    elif not len(command):
        missing.append("no recorded command is found among the applied torques")
    stamps = commands.stamp_ns[new][command]
    begins = ticks.start_ns[changed][tick]
    columns = {
        "time_s": begins / NANOSECONDS,
        "received_us": (step_ns[tick] - commands.received_ns[new][command]) / 1e3,
        "stamped_us": np.where(stamps > 0, (begins + recording.start_ns - stamps) / 1e3, np.nan),
    }
    # A torque that is commanded once and for all answers no samples.
    if len(begins) > 1:
        answers |= _measure_answers(recording, begins)
    return require("pandas").DataFrame(columns), answers


def _measure_answers(recording: Recording, begins: Integers) -> dict[str, float]:
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
    share = 100.0 * float(np.mean(answered[:-1]))
    age = float(held.mean() / NANOSECONDS) if len(held) else 0.0
    return {"samples_answered_percent": share, "command_age_mean_s": age}


def _changes(torque: Array) -> NDArray[np.intp]:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero((np.diff(torque, axis=0, prepend=np.nan) != 0.0).any(axis=1))


def _pairs(
    asked: Array, earliest_ns: Integers, applied: Array, applied_ns: Integers
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find for each command the first tick of its values from `earliest_ns` on."""
    pandas, legs = require("pandas"), ["1", "2", "3"]
    commands, ticks = (
        pandas.DataFrame(torque + 0.0, columns=legs).assign(ns=ns, row=np.arange(len(ns)))
        for torque, ns in ((asked, earliest_ns), (applied, applied_ns))
    )
    found = pandas.merge_asof(
        commands.sort_values("ns", kind="stable"),
        ticks.sort_values("ns", kind="stable"),
        on="ns",
        by=legs,
        direction="forward",
    ).dropna(subset="row_y")
    # Commands are in order of reception: the last of those that share a tick is the one it took.
    found = found.sort_values("row_x").drop_duplicates("row_y", keep="last")
    return found["row_x"].to_numpy(), found["row_y"].to_numpy(dtype=int)


def energy_residual(recording: Recording, missing: list[str]) -> Array:
    """Return the energy balance residual since the start [J], shape (n,).

    Args:
        recording: a run.
        missing: gets a line for all that is not known.

    Returns:
        nan where it is not known. Where ticks are lost, the balance goes on without them.

    """
    count, moment = len(recording.time_ns), recording.scene.moment
    stored, work = np.full((2, count), np.nan)
    if moment and moment.topic and recording.ticks.moment is None:
        missing.append("the moment on the star is not recorded: no energy residual")
        return stored
    ticks = ticks_of(recording)
    many = len(ticks.start_ns) > COMPILED_FROM
    if many and compiled_module.numba_version() is None:
        count = int(np.searchsorted(recording.time_ns, ticks.end_ns[PLAIN_TICKS - 1])) + 1
        until = recording.seconds[count - 1]
        missing.append(f"energy after {until:g} s: there is no numba to balance it")
    geometry, model = Geometry.of(recording.scene), kernel.model_of(recording.scene)
    motion = TickPropagator(recording.scene, None, compiled=many)
    for part in slices(count, CHUNK, "energy", shown=False):
        rows = slice(part.start, min(part.stop + 1, count))
        state = of_samples(geometry, recording, rows)
        columns = tuple(state.T)
        kinetic = kernel.kinetic_energy(model, columns)
        stored[rows] = kinetic + kernel.potential_energy(model, columns)
        work[rows.start : rows.stop - 1] = _work(motion, ticks, state, recording.time_ns[rows])
    change = np.diff(stored, prepend=stored[0]) - np.append(0.0, work[:-1])
    change[~np.isfinite(change)] = 0.0
    return np.asarray(np.where(np.isfinite(stored), np.cumsum(change), np.nan))


def _work(motion: TickPropagator, every: TickSequence, state: Array, time: Integers) -> Array:
    """Work from each of n samples to the next [J], shape (n - 1,).

    It is nan where ticks or states are lost.
    """
    begin, end = np.searchsorted(every.start_ns, time[[0, -1]])
    ticks = every.part(slice(begin, end))
    first, last = places(ticks.start_ns, time[:-1]), places(ticks.end_ns, time[1:])
    # The ticks of a sample are all there if they last as long as it is to the next.
    whole = (first >= 0) & (last >= first) & np.isfinite(state[:-1]).all(axis=1)
    passed = np.append(0, np.cumsum(ticks.end_ns - ticks.start_ns))
    whole &= passed[last + 1] - passed[first] == np.diff(time)
    if not whole.any():
        return np.full(len(whole), np.nan)
    starts = np.full((len(ticks.start_ns), state.shape[1]), np.nan)
    starts[first[whole]] = state[:-1][whole]
    begin = int(first[whole][0])
    reached = np.full(len(starts), np.nan)
    reached[begin:] = motion.follow(ticks.part(slice(begin, None)), starts[begin:])[:, 0, -1]
    return np.where(whole, reached[last], np.nan)
