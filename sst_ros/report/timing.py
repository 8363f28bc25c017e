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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.dynamics import kernel
from sst_ros.extras import require
from sst_ros.host.output import slices
from sst_ros.integration import codegen
from sst_ros.integration.propagator import TickPropagator, TickSequence
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.recording.recording import Recording
from sst_ros.recording.topic_tables import Integers
from sst_ros.report import states
from sst_ros.report.states import CHUNK, COMPILED_FROM, PLAIN_TICKS, ticks_of
from sst_ros.state import NANOSECONDS

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
        period_us: time between receptions of samples that follow each other [us], shape (p,).
        nominal_us: what it should be [us].
        lost_s: times of lost samples [s], shape (l,).
        gaps_s: times at which a tick does not begin where the one before ended [s].
        pace_s, pace: times [s] and simulated time per time on the recorder's clock.
        late_us: reception delay of each sample relative to the fastest one, by its stamp
            [us], shape (n,): it grows where the simulator falls behind.
        reported: a row for each of the simulator's reports: time of the run [s], and the numbers
            of REPORTED, nan where one was not reported, shape (r, 1 + len(REPORTED)).
        latency: of commands.
        energy: energy balance residual of each sample since the start [J], shape
            (n,); nan where it is not known.
        missing: what is not known, and why.

    """

    period_us: Array
    nominal_us: float
    lost_s: Array
    gaps_s: Array
    pace_s: Array
    pace: Array
    late_us: Array
    reported: Array
    latency: Latency
    energy: Array
    missing: tuple[str, ...]


def measure(recording: Recording) -> Timing:
    """Measure a recording."""
    missing: list[str] = []
    spacing, period = np.diff(recording.time_ns), recording.period_ns
    follow = spacing == period
    received = np.diff(recording.received_ns)[follow] / 1e3
    if np.any(received < 0.0):
        missing.append("receptions are not in the order of the samples: periods are as recorded")
    lost = [
        recording.time_ns[row] + period * np.arange(1, round(spacing[row] / period))
        for row in np.flatnonzero(spacing > period).tolist()
    ]
    ticks = recording.ticks
    gaps = ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]]
    # Simulated time per received time, over pieces of the run.
    pieces = min(60, len(recording.time_ns) - 1)
    rows = np.unique(np.linspace(0, len(recording.time_ns) - 1, pieces + 1).round().astype(int))
    piece = recording.time_ns[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(piece) / np.diff(recording.received_ns[rows])
    good = np.isfinite(pace) & (pace > 0.0)
    late = recording.received_ns - recording.time_ns
    if not recording.diagnostics:
        missing.append("no diagnostics: missed ticks and samples published are not known")
    return Timing(
        period_us=received,
        nominal_us=period / 1e3,
        lost_s=np.concatenate(lost) / NANOSECONDS if lost else np.empty(0),
        gaps_s=gaps / NANOSECONDS,
        pace_s=(0.5 * (piece[1:] + piece[:-1]) / NANOSECONDS)[good],
        pace=pace[good],
        late_us=(late - late.min()) / 1e3,
        reported=_read_reports(recording),
        latency=pair_commands(recording, missing),
        energy=energy_residual(recording, missing),
        missing=tuple(missing),
    )


def numbers(timing: Timing) -> dict[str, Any]:
    """Sum it up: flat, units in the names, None for what is not known."""
    latency, energy = timing.latency, np.abs(timing.energy)
    delays = {
        "period": timing.period_us,
        "command_latency": latency.received_us,
        "command_stamp_to_tick": latency.stamped_us[np.isfinite(latency.stamped_us)],
    }
    return {
        **{
            f"{name}_{word}_us": float(function(values)) if len(values) else None
            for name, values in delays.items()
            for word, function in STATISTICS.items()
        },
        "commands_followed": len(latency.time_s),
        "samples_answered_percent": latency.answered and 100.0 * latency.answered,
        "command_age_mean_s": latency.age_s,
        "energy_residual_max_J": float(np.nanmax(energy)) if np.isfinite(energy).any() else None,
        "unknown": list(timing.missing),
    }


def _read_reports(recording: Recording) -> Array:
    """Return times of the run [s] and the numbers of REPORTED, from the simulator's reports."""
    rows = [
        [at - recording.received_ns[0], *(float(values.get(key) or "nan") for key in REPORTED)]
        for at, values in recording.reports
    ]
    reported = np.array(rows, dtype=float).reshape(-1, 1 + len(REPORTED))
    since = (recording.received_ns - recording.received_ns[0]).astype(float)
    reported[:, 0] = np.interp(reported[:, 0], since, recording.seconds)
    return reported


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


def pair_commands(recording: Recording, missing: list[str]) -> Latency:
    """Pair commands with ticks, by their values; `missing` gets a line where there are none."""
    commands, ticks, none = recording.commands, recording.ticks, Latency(*np.empty((3, 0)))
    if not len(commands.torque):
        missing.append("no commands are recorded: their latency is not known")
        return none
    limit = recording.scene.torque_limit
    most = np.inf if limit is None else limit
    asked, applied = (np.clip(each.torque, -most, most) for each in (commands, ticks))
    new, changed = _changes(asked), _changes(applied)
    step_ns = _reception_of(recording, ticks.end_ns[changed])
    # The recorder may have received a command a little later than the simulator.
    earliest_ns = commands.received_ns[new] - ticks.period_ns
    command, tick = _pairs(asked[new], earliest_ns, applied[changed], step_ns)
    if not len(command):
        missing.append("no recorded command is found among the applied torques")
        return none
    stamps = commands.stamp_ns[new][command]
    begins = ticks.start_ns[changed][tick]
    answered = np.where(stamps > 0, (begins + recording.start_ns - stamps) / 1e3, np.nan)
    passed = (step_ns[tick] - commands.received_ns[new][command]) / 1e3
    # A torque that is commanded once and for all answers no samples.
    share, age = _measure_answers(recording, begins) if len(begins) > 1 else (None, None)
    return Latency(begins / NANOSECONDS, passed, answered, share, age)


def _measure_answers(recording: Recording, begins: Integers) -> tuple[float, float]:
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


def _reception_of(recording: Recording, time_ns: Integers) -> Integers:
    """Return when times of the run were received [ns], interpolated between samples."""
    first = recording.received_ns[0]
    since = (recording.received_ns - first).astype(float)
    return np.asarray(first + np.interp(time_ns, recording.time_ns, since).astype(np.int64))


def _changes(torque: Array) -> NDArray[np.intp]:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero(np.append(True, (torque[1:] != torque[:-1]).any(axis=1)))


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
    if many and codegen.numba_version() is None:
        count = int(np.searchsorted(recording.time_ns, ticks.end_ns[PLAIN_TICKS - 1])) + 1
        until = recording.seconds[count - 1]
        missing.append(f"energy after {until:g} s: there is no numba to balance it")
    geometry, model = Geometry.of(recording.scene), kernel.model_of(recording.scene)
    motion = TickPropagator(recording.scene, None, compiled=many)
    for part in slices(count, CHUNK, "energy", shown=False):
        rows = slice(part.start, min(part.stop + 1, count))
        state = states.of_samples(geometry, recording, rows)
        columns = tuple(state.T)
        kinetic = kernel.kinetic_energy(model, columns)
        stored[rows] = kinetic + kernel.potential_energy(model, columns)
        work[rows.start : rows.stop - 1] = _work(motion, ticks, state, recording.time_ns[rows])
    change = np.zeros(len(stored))
    change[1:] = np.diff(stored) - work[:-1]
    change[~np.isfinite(change)] = 0.0
    return np.asarray(np.where(np.isfinite(stored), np.cumsum(change), np.nan))


def _work(motion: TickPropagator, every: TickSequence, state: Array, time: Integers) -> Array:
    """Work from each of n samples to the next [J], shape (n - 1,).

    It is nan where ticks or states are lost.
    """
    places = np.searchsorted(every.start_ns, time)
    ticks = every.part(slice(places[0], places[-1]))
    whole = np.zeros(len(state) - 1, dtype=bool)
    if len(ticks.start_ns):
        places -= places[0]
        # The ticks of a sample are all there if they follow each other from its time to the next.
        breaks = np.concatenate([[0], np.cumsum(ticks.start_ns[1:] != ticks.end_ns[:-1])])
        first, last = np.minimum(places[:-1], len(breaks) - 1), np.maximum(places[1:] - 1, 0)
        whole = (first <= last) & (breaks[first] == breaks[last])
        whole &= (ticks.start_ns[first] == time[:-1]) & (ticks.end_ns[last] == time[1:])
        whole &= np.isfinite(state[:-1]).all(axis=1)
    if not whole.any():
        return np.full(len(whole), np.nan)
    starts = np.full((len(ticks.start_ns), state.shape[1]), np.nan)
    starts[first[whole]] = state[:-1][whole]
    begin = int(first[whole][0])
    reached = np.full(len(starts), np.nan)
    reached[begin:] = motion.follow(ticks.part(slice(begin, None)), starts[begin:])[:, 0, -1]
    return np.where(whole, reached[last], np.nan)
