# SPDX-License-Identifier: Apache-2.0
"""The evaluation of one recorded run, from its bag alone: numbers and findings.

The numbers are one flat mapping, units in the names, nothing that is not finite; what a
recording does not contain is None, never a guess.

Periods are between the receptions of consecutive samples by the recorder, so that they
hold the jitter of simulator, transport and recorder together. A command is paired with
the first tick that applies its values. Two delays are measured:

- By the recorder's clock, from the reception of the command to the step. The simulator
  begins the step of a tick when the tick ends, with the newest command that it has;
  when that was is read from the receptions of the samples, at the tick's end between
  two of them. This holds at any pace and with any clock in the stamps, and includes the
  transport of the samples to the recorder.
- By stamps, from that of a command, which is that of the sample it answers, to the
  beginning of the tick: simulated time between what was measured and what was done
  about it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas import DataFrame, Series

from sst_ros.recording.recording import Recording
from sst_ros.report import reference, tracking
from sst_ros.report.reference import COMPARED_UNITS, Comparison
from sst_ros.report.results import (
    Finding,
    Severity,
    largest,
    made_on,
    render,
    texts_of,
    verdict_of,
)
from sst_ros.state import NANOSECONDS, Array

# of the integration, where the tolerance of the run was not recorded
ERROR_LIMIT_RAD = 1e-9

REPORTED = (
    *("ticks_missed", "ticks", "step_mean_us"),
    *("error_estimate", "hold_error_start", "hold_error_middle"),
)
"""Numbers of the diagnostics that are shown over the run."""

STATISTICS = {
    "min": "min",
    "mean": "mean",
    "99%": "p99",
    "99.9%": "p99_9",
    "max": "max",
}
"""What is shown of periods and delays, as pandas and as the summary name it."""

PACE_PIECES = 60
"""At most so many pieces of a run, whose pace is a line over the run."""

LEAST_ANSWERED_PERCENT = 90.0
"""A controller at the rate of the samples answers nearly all of them; one that is late
or whose commands are lost answers fewer."""


class Timing(NamedTuple):
    """Timing of a recording by its clocks."""

    # between receptions of samples that follow each other [us], shape (p,)
    period_us: Array
    lost_s: Array  # times of lost samples [s], shape (l,)
    gaps_s: Array  # times at which a tick does not begin where the one before ended [s]
    # simulated time per time on the recorder's clock, over time [s]
    pace: Series[float]
    reported: DataFrame
    """A row for each of the simulator's reports: time_s of the run, and the numbers of
    REPORTED, nan where one was not reported.
    """
    commands: DataFrame
    """A row for each command that was followed: time_s, when the tick begins that
    applied it; received_us, from its reception to the step; stamped_us, from its stamp
    to the beginning of the tick, nan where it has none; tick, its number.
    """
    # all in all: flat, units in the names, None for what is not known
    numbers: dict[str, Any]
    missing: list[str]  # what is not known, and why


class RunEvaluation(NamedTuple):
    """A run in numbers: its timing, two comparisons, and the summary."""

    timing: Timing
    integration: Comparison
    ideal: Comparison | None
    summary: dict[str, Any]


def evaluate_run(run: Recording) -> RunEvaluation:
    """Evaluate a recorded run."""
    timing = measure_timing(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        ideal_comparison = pool.submit(reference.ideal, run)
        integration = reference.integration(run)
        ideal = ideal_comparison.result()
    numbers = {
        **_count(run, timing),
        **summarise(run, integration, ideal),
        **timing.numbers,
    }
    findings = find_findings(run, integration, ideal, numbers)
    summary = {
        "verdict": verdict_of(findings),
        "reasons": texts_of(findings, Severity.WARNING),
        "notes": texts_of(findings, Severity.NOTE),
        **numbers,
    }
    return RunEvaluation(timing, integration, ideal, summary)


def summary_text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures that matter and the place of the files."""
    return render("run.txt", part="text", s=summary, folder=folder)


def summary_table(summary: dict[str, Any]) -> str:
    """Format a whole summary as an aligned table; what is unknown is a dash."""
    return render("run.txt", part="table", s=summary)


def summarise(
    run: Recording, integration: Comparison, ideal: Comparison | None
) -> dict[str, Any]:
    """Collect the figures of what was computed anew.

    These are errors, energy, tracking and efforts.
    """
    return {
        "torque_peak_N_m": np.abs(run.ticks.torque).max(axis=0).tolist(),
        **_summarise_tracking(run),
        **_summarise_measurement(run),
        **_summarise_errors(integration, ideal),
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
        "energy_residual_max_J": largest(np.abs(integration.energy)),
        **_summarise_efforts(run),
    }


def _summarise_tracking(run: Recording) -> dict[str, Any]:
    """Return how closely the run followed its reference, if it had one."""
    tracked = tracking.of(run)
    if tracked is None:
        names = "tracking_error_rms_rad", "tracking_error_max_rad", "settling_time_s"
        return dict.fromkeys(names)
    return {
        "tracking_error_rms_rad": tracked.metrics.rms.tolist(),
        "tracking_error_max_rad": tracked.metrics.largest.tolist(),
        "settling_time_s": tracked.metrics.settling,
    }


def _summarise_measurement(run: Recording) -> dict[str, Any]:
    """Return which motion is evaluated, and what the measured one is off it."""
    if run.motion is run.measured:
        return {
            "motion_of": "joint_states",
            "measurement_error_max_rad": None,
            "measurement_error_rms_rad": None,
        }
    error = run.measured_error
    rms = None
    if np.isfinite(error).any():
        rms = largest(np.sqrt(np.nanmean(error**2, axis=0)))
    return {
        "motion_of": None if run.motion is None else "true_joint_states",
        "measurement_error_max_rad": largest(error),
        "measurement_error_rms_rad": rms,
    }


def _summarise_errors(
    integration: Comparison, ideal: Comparison | None
) -> dict[str, float | None]:
    """Return the largest errors of each comparison, by quantity."""
    tables = {
        "integration_error": integration.error,
        "integration_reference_error": integration.own,
    }
    if ideal:
        tables["ideal_difference"] = ideal.error
        tables["ideal_reference_error"] = ideal.own
    numbers = {}
    for name, table in tables.items():
        for quantity, unit in COMPARED_UNITS.items():
            numbers[f"{name}_{quantity}_{unit}"] = largest(table[quantity])
    return numbers


def _summarise_efforts(run: Recording) -> dict[str, float | None]:
    """Return how far recorded efforts are from the applied torques, and when."""
    difference = largest(run.effort_difference)
    time = None if difference is None else 0.0
    if difference:
        time = float(run.seconds[np.nanargmax(run.effort_difference)])
    return {
        "effort_difference_max_N_m": difference,
        "effort_difference_largest_at_s": time,
    }


def _count(run: Recording, timing: Timing) -> dict[str, Any]:
    """Collect what was recorded.

    These are the last diagnostics of the simulator, samples, ticks and losses.
    """
    diagnostics = pd.Series(run.diagnostics, dtype=object)
    numbers = {}
    for key, value in pd.to_numeric(diagnostics, errors="coerce").items():
        if np.isfinite(value):
            numbers[key] = value
    counts = {key: round(value) for key, value in numbers.items()}
    recorded = len(run.time_ns)
    missing_between = len(timing.lost_s)
    published = counts.get("samples_published")
    # Diagnostics that end before the run does know of fewer samples than the bag holds.
    lost = max(missing_between, (published or 0) - recorded)
    stamp_gaps = np.count_nonzero(np.diff(run.time_ns) > run.period_ns)
    return {
        "scene": run.scene.name,
        "bag": str(run.path),
        "phase": run.diagnostics.get("phase"),
        "fault": run.diagnostics.get("fault"),
        "integrator": run.diagnostics.get("integrator"),
        "ticks": counts.get("ticks"),
        "ticks_missed": counts.get("ticks_missed"),
        "commands_received": counts.get("commands_received"),
        "commands_dropped": counts.get("commands_dropped"),
        "simulated_time_s": numbers.get("simulated_time_s"),
        "wall_time_s": numbers.get("wall_time_s"),
        "real_time_factor": numbers.get("real_time_factor"),
        "step_mean_us": numbers.get("step_mean_us"),
        "step_max_us": numbers.get("step_max_us"),
        "simulator_error_estimate": numbers.get("error_estimate"),
        "error_limit_rad": numbers.get("tolerance") or ERROR_LIMIT_RAD,
        "duration_s": float(run.seconds[-1]),
        "commands_recorded": len(run.commands.torque),
        "samples_published": published,
        "samples_recorded": recorded,
        "samples_lost": lost,
        "samples_recorded_percent": 100.0 * recorded / (recorded + lost),
        "sample_period_s": run.period_ns / NANOSECONDS,
        "stamp_gaps": int(stamp_gaps),
        "samples_missing_between_stamps": missing_between,
        "idle_states": run.idle_states,
        "foreign_states": run.foreign_states,
        "samples_measured": len(run.measured.time_ns),
        "tick_period_s": run.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(run.ticks.start_ns),
        "tick_gaps": run.ticks.gaps,
        "actuators_lag": run.scene.lags,
        "topics_missing": list(run.missing),
        "damage": list(run.signals.bag.damage),
        "unknown": timing.missing,
        "report": made_on(),
    }


def measure_timing(recording: Recording) -> Timing:
    """Measure how regular a recorded run was."""
    ticks = recording.ticks
    missing: list[str] = []
    spacing = np.diff(recording.time_ns)
    follows = spacing == recording.period_ns
    period_us = np.diff(recording.received_ns)[follows] / 1e3
    if np.any(period_us < 0.0):
        missing.append(
            "receptions are not in the order of the samples: periods are as recorded"
        )
    if not recording.diagnostics:
        missing.append(
            "no diagnostics: missed ticks and samples published are not known"
        )
    commands = pair_commands(recording)
    if not len(recording.commands.torque):
        missing.append("no commands are recorded: their latency is not known")
    elif commands.empty:
        missing.append("no recorded command is found among the applied torques")
    numbers: dict[str, Any] = {
        "commands_followed": len(commands),
        **_measure_answers(recording, commands),
    }
    for name, values in (
        ("period", pd.Series(period_us, dtype=float)),
        ("command_latency", commands.received_us),
        ("command_stamp_to_tick", commands.stamped_us),
    ):
        described = values.describe([0.99, 0.999]).dropna()
        for key, statistic in STATISTICS.items():
            numbers[f"{name}_{statistic}_us"] = described.get(key)
    gap_before = ticks.start_ns[1:] != ticks.end_ns[:-1]
    return Timing(
        period_us=period_us,
        lost_s=_lost_times(recording),
        gaps_s=ticks.end_ns[:-1][gap_before] / NANOSECONDS,
        pace=_measure_pace(recording),
        reported=_reported_numbers(recording),
        commands=commands,
        numbers=numbers,
        missing=missing,
    )


def _lost_times(recording: Recording) -> Array:
    """Return the times [s] of samples that are missing between others."""
    period_ns = recording.period_ns
    spacing = np.diff(recording.time_ns)
    lost_ns = [np.empty(0)]
    for row in np.flatnonzero(spacing > period_ns).tolist():
        count = round(spacing[row] / period_ns)
        lost_ns.append(recording.time_ns[row] + period_ns * np.arange(1, count))
    return np.concatenate(lost_ns) / NANOSECONDS


def _measure_pace(recording: Recording) -> Series[float]:
    """Return simulated time per received time over pieces of the run."""
    time_ns = recording.time_ns
    borders = np.linspace(0, len(time_ns) - 1, min(PACE_PIECES + 1, len(time_ns)))
    rows = np.unique(borders.round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(time_ns[rows]) / np.diff(recording.received_ns[rows])
    middle = 0.5 * (time_ns[rows][1:] + time_ns[rows][:-1]) / NANOSECONDS
    usable = np.isfinite(pace) & (pace > 0.0)
    return pd.Series(pace[usable], middle[usable])


def _reported_numbers(recording: Recording) -> DataFrame:
    """Return the numbers of the simulator's reports, see `Timing.reported`."""
    reports = [values for _, values in recording.reports]
    reported = pd.DataFrame(reports, columns=REPORTED).replace("", None).astype(float)
    first_ns = int(recording.received_ns[0])
    reported_ns = [when_ns - first_ns for when_ns, _ in recording.reports]
    received_ns = (recording.received_ns - first_ns).astype(float)
    seconds = np.interp(reported_ns, received_ns, recording.seconds)
    reported.insert(0, "time_s", seconds)
    return reported


def pair_commands(recording: Recording) -> DataFrame:
    """Pair commands with ticks, by their values: `Timing.commands`.

    Each has the first tick of its values from its reception on, or from a tick before
    it: the recorder may have received it a little later than the simulator.
    """
    legs = ["leg 1", "leg 2", "leg 3"]
    commands = recording.commands
    ticks = recording.ticks
    limit = recording.scene.torque_limit
    if limit is None:
        limit = np.inf
    # Zero is added because -0 and 0 are equal, but not in a merge.
    commanded = np.clip(commands.torque, -limit, limit) + 0.0
    applied = np.clip(ticks.torque, -limit, limit) + 0.0
    new_commands = _changes(commanded)
    changed_ticks = _changes(applied)
    # When the steps of ticks began, interpolated between the receptions of samples.
    first_ns = recording.received_ns[0]
    since_ns = (recording.received_ns - first_ns).astype(float)
    steps_since_ns = np.interp(ticks.end_ns, recording.time_ns, since_ns)
    step_ns = first_ns + steps_since_ns.astype(np.int64)
    earliest_ns = commands.received_ns[new_commands] - ticks.period_ns
    sent = pd.DataFrame(commanded[new_commands], columns=legs)
    sent = sent.assign(command=new_commands, time_ns=earliest_ns)
    sent = sent.sort_values("time_ns", kind="stable")
    stepped = pd.DataFrame(applied[changed_ticks], columns=legs)
    stepped = stepped.assign(tick=changed_ticks, time_ns=step_ns[changed_ticks])
    stepped = stepped.sort_values("time_ns", kind="stable")
    pairs = pd.merge_asof(sent, stepped, on="time_ns", by=legs, direction="forward")
    # Commands are in order of reception: the last of those that share a tick is the one
    # it took.
    pairs = pairs.dropna(subset="tick").sort_values("command")
    pairs = pairs.drop_duplicates("tick", keep="last")
    command = pairs["command"].to_numpy(dtype=int)
    tick = pairs["tick"].to_numpy(dtype=int)
    stamps_ns = commands.stamp_ns[command]
    begins_ns = ticks.start_ns[tick]
    age_us = (begins_ns + recording.start_ns - stamps_ns) / 1e3
    return pd.DataFrame(
        {
            "time_s": begins_ns / NANOSECONDS,
            "received_us": (step_ns[tick] - commands.received_ns[command]) / 1e3,
            "stamped_us": np.where(stamps_ns > 0, age_us, np.nan),
            "tick": tick,
        }
    )


def _changes(torque: Array) -> NDArray[np.intp]:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero((np.diff(torque, axis=0, prepend=np.nan) != 0.0).any(axis=1))


def _measure_answers(
    recording: Recording, paired: DataFrame
) -> dict[str, float | None]:
    """Return the share of samples that a command answered.

    Also the mean age [s] of the command of a tick. Both are None for a torque that is
    commanded once and for all, which answers no samples.
    """
    if len(paired) <= 1:
        return {"samples_answered_percent": None, "command_age_mean_s": None}
    commands = recording.commands
    samples = recording.measured  # what a controller receives
    if commands.stamp_ns.any():
        answered = np.isin(samples.time_ns + recording.start_ns, commands.stamp_ns)
    else:
        received_ns = samples.received_ns
        counts = np.searchsorted(commands.received_ns, received_ns, side="left")
        answered = np.append(np.diff(counts), 0) > 0
    # The last sample is the end of the run, which nothing answers.
    share = 100.0 * float(np.mean(answered[:-1]))
    start_ns = recording.ticks.start_ns
    command_starts = np.sort(start_ns[paired.tick])
    command = np.searchsorted(command_starts, start_ns, side="right") - 1
    has_command = command >= 0
    ages = start_ns[has_command] - command_starts[command[has_command]]
    age = float(ages.mean() / NANOSECONDS) if len(ages) else 0.0
    return {"samples_answered_percent": share, "command_age_mean_s": age}


def find_findings(
    run: Recording,
    integration: Comparison,
    ideal: Comparison | None,
    numbers: Mapping[str, Any],
) -> list[Finding]:
    """Return warnings, the weightiest first, then notes.

    Args:
        run: the recording.
        integration: its comparison with the same torques.
        ideal: its comparison with continuous torques, if there is one.
        numbers: the numbers of its summary.

    """
    warnings = [Finding(Severity.WARNING, text) for text in _find_warnings(numbers)]
    notes = [
        *_note_recording(run),
        *_note_comparisons(run, integration, ideal),
        *_note_measurement(run, numbers),
    ]
    return warnings + [Finding(Severity.NOTE, text) for text in notes]


def _find_warnings(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with a run, the weightiest first."""
    phase = numbers["phase"]
    if numbers["fault"]:
        yield f"fault: {numbers['fault']}"
    elif phase not in (None, "finished"):
        yield f"the run was cut short, or its recording was: last phase {phase}"
    yield from numbers["damage"]
    if numbers["samples_lost"]:
        recorded = numbers["samples_recorded_percent"]
        yield f"{numbers['samples_lost']} samples lost ({recorded:.2f} % recorded)"
    if numbers["tick_gaps"]:
        yield f"{numbers['tick_gaps']} gaps between applied torques"
    if numbers["ticks_missed"]:
        yield f"{numbers['ticks_missed']} ticks missed by the simulator"
    answered = numbers["samples_answered_percent"]
    if answered is not None and answered < LEAST_ANSWERED_PERCENT:
        age_ms = 1e3 * numbers["command_age_mean_s"]
        yield f"commands answered {answered:.3g} % of samples, mean age {age_ms:.3g} ms"
    limit = numbers["error_limit_rad"]
    errors = {
        "integration error": numbers["integration_error_gamma_rad"],
        "error estimate": numbers["simulator_error_estimate"],
    }
    for name, error in errors.items():
        if error is not None and error > limit:
            yield f"{name} {error:.1e} rad above {limit:.0e} rad"
    difference = numbers["effort_difference_max_N_m"]
    if difference and not numbers["actuators_lag"]:
        yield f"efforts differ from applied torques by {difference:.1e} N m"


def _note_recording(run: Recording) -> Iterator[str]:
    """Yield what the recording says of the course of the run."""
    phase = run.diagnostics.get("phase")
    fault = run.diagnostics.get("fault")
    if not run.diagnostics:
        yield (
            "no diagnostics are recorded: missed ticks and error estimates are unknown"
        )
    elif phase not in ("finished", "fault"):
        yield f"the run or its recording was cut short: the last phase is {phase}"
    if phase == "fault" or fault:
        end = float(run.seconds[-1])
        yield (
            "the run ended by a fault; it is compared up to its last sample, at "
            f"{end:.6f} s"
        )
    if not reference.begins(run):
        yield "the start of the run is not recorded; times count from the first sample"


def _note_comparisons(
    run: Recording, integration: Comparison, ideal: Comparison | None
) -> Iterator[str]:
    """Yield what could not be compared."""
    moment = run.scene.moment
    pushed = bool(moment and moment.topic)
    if pushed and run.ticks.moment is None:
        yield (
            "the moment on the star came from a topic and is not recorded: nothing is "
            "compared"
        )
    left_out = len(run.time_ns) - integration.compared
    restarts = len(integration.restarts_ns)
    if restarts:
        yield (
            f"torques are missing: the reference began again {restarts} times from a "
            f"recorded sample; {left_out} samples are not compared"
        )
    elif left_out:
        yield f"{left_out} samples could not be compared"
    if ideal is None and pushed:
        yield "the moment comes from a topic: no ideal to compare with"
    if ideal is None and run.scene.torque is None:
        yield "the scene has no torques: no ideal to compare with"


def _note_measurement(run: Recording, numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the recorded signals are, and are not."""
    if numbers["motion_of"] != "joint_states":
        rms = numbers["measurement_error_rms_rad"]
        most = numbers["measurement_error_max_rad"]
        off = f"{rms:.1e} rad RMS, {most:.1e} rad at most"
        if numbers["motion_of"] == "true_joint_states":
            yield (
                "integration error and energy are those of the true motion "
                "(true_joint_states), tracking is that of the measured one "
                f"(joint_states), which is off by {off}"
            )
        else:
            yield (
                f"joint_states are measured, off the orientation by {off}, and "
                "true_joint_states are not recorded: the integration error is that of "
                "the orientation; rates and energy are not compared"
            )
    if numbers["foreign_states"]:
        count = numbers["foreign_states"]
        yield f"{count} joint states of other robots are left out"
    if run.scene.lags:
        yield "the actuators lag: efforts differ from the torques that are asked for"
    if run.signals.bag.unverified:
        count = run.signals.bag.unverified
        yield f"{count} chunks have no checksum: damage would not be noticed"
    if "euler_zyz" in run.missing:
        yield ("euler_zyz is not recorded: its pictures show the orientation's angles")
