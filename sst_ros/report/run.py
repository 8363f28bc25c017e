# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone: numbers, page and pictures.

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

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from pandas import DataFrame, Series

from sst_ros import figures
from sst_ros.figures import BLUE, GREY, LINES, Looks, hide_zeros
from sst_ros.files import write_into
from sst_ros.plot import pictures
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import findings, reference, tracking
from sst_ros.report.findings import Severity
from sst_ros.report.reference import QUANTITIES, Comparison
from sst_ros.report.results import largest, made_on, provenance, publish, render
from sst_ros.state import NANOSECONDS, Array

DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that the report has, too."""

PAGE, HTML = "page.png", "page.html"

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
    measured = measure_timing(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    numbers = (
        _count(run, measured) | summarise(run, integration, ideal) | measured.numbers
    )
    found = findings.find_all(run, integration, ideal, numbers)
    summary = {
        "verdict": findings.verdict(found),
        "reasons": findings.texts(found, Severity.WARNING),
        "notes": findings.texts(found, Severity.NOTE),
        **numbers,
    }
    return RunEvaluation(measured, integration, ideal, summary)


def write_run_report(
    bag: Path, out: Path, *, damaged: bool = False, namespace: str | None = None
) -> dict[str, Any]:
    """Evaluate a recorded run.

    Write summary.json, the page and the pictures into `out`.

    Of a `damaged` recording what is intact is evaluated; the `namespace` is that of
    `read_bag`. The summary is returned; `summary_text` makes a short text of it,
    `summary_table` the whole. Raises InputError where the bag is no whole recording of
    a run, or `out` cannot be written.
    """
    run = recording.read(bag, damaged=damaged, namespace=namespace)
    with write_into(out, "report"):
        found = evaluate_run(run)
        drawn, _ = pictures.draw_run(run.signals, out, DRAWN, ["png"])
        title = f"Error against run time, {run.scene.name}"
        drawn += pictures.save(
            draw_errors(run.seconds, found), title, out, "error", ["png"]
        )
        figures.save_figure(draw_overview(run, found), out / PAGE)
        result = found.summary | {
            "pictures": [path.name for path in drawn],
            "page": [PAGE, HTML],
        }
        given = {"s": result, "table": summary_table(result), "overview": out / PAGE}
        page = render("run.html", pictures=drawn, **given)
        publish(out, "report", {HTML: page, "summary.json": result})
    return result


def summary_text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures that matter and the place of the files."""
    return render("run.txt", part="text", s=summary, folder=folder)


def summary_table(summary: dict[str, Any]) -> str:
    """Format a whole summary as an aligned table; what is unknown is a dash."""
    return render("run.txt", part="table", s=summary)


def summarise(
    run: Recording, integration: Comparison, ideal: Comparison | None
) -> dict[str, Any]:
    """Collect the figures of what was computed anew: errors, energy, tracking, efforts."""
    tracked = tracking.of(run)
    found, off = tracked and tracked.metrics, largest(run.effort_difference)
    measured = run.motion is not run.measured
    apart = run.measured_error if measured else np.full((1, 3), np.nan)
    compared = {
        "integration_error": integration.error,
        "integration_reference_error": integration.own,
    }
    if ideal:
        compared |= {
            "ideal_difference": ideal.error,
            "ideal_reference_error": ideal.own,
        }
    return {
        "torque_peak_N_m": np.abs(run.ticks.torque).max(axis=0).tolist(),
        "tracking_error_rms_rad": found and found.rms.tolist(),
        "tracking_error_max_rad": found and found.largest.tolist(),
        "settling_time_s": found and found.settling,
        "motion_of": "joint_states"
        if not measured
        else run.motion and "true_joint_states",
        "measurement_error_max_rad": largest(apart),
        "measurement_error_rms_rad": largest(np.sqrt(np.nanmean(apart**2, axis=0)))
        if np.isfinite(apart).any()
        else None,
        **{
            f"{name}_{key}_{unit}": largest(table[key])
            for name, table in compared.items()
            for key, unit in QUANTITIES.items()
        },
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
        "energy_residual_max_J": largest(np.abs(integration.energy)),
        "effort_difference_max_N_m": off,
        "effort_difference_largest_at_s": off
        and float(run.seconds[np.nanargmax(run.effort_difference)]),
    }


def _count(run: Recording, measured: Timing) -> dict[str, Any]:
    """Collect what was recorded: the last diagnostics of the simulator, samples, ticks, losses."""
    period, recorded, spacing = run.period_ns, len(run.time_ns), np.diff(run.time_ns)
    said = pd.to_numeric(pd.Series(run.diagnostics, dtype=object), errors="coerce")
    numbers = {key: value for key, value in said.items() if np.isfinite(value)}
    counts = {key: round(value) for key, value in numbers.items()}
    between, published = len(measured.lost_s), counts.get("samples_published")
    # Diagnostics that end before the run does know of fewer samples than the bag holds.
    lost = max(between, (published or 0) - recorded)
    whole = ("ticks", "ticks_missed", "commands_received", "commands_dropped")
    times = (
        "simulated_time_s",
        "wall_time_s",
        "real_time_factor",
        "step_mean_us",
        "step_max_us",
    )
    return {
        "scene": run.scene.name,
        "bag": str(run.path),
        **{key: run.diagnostics.get(key) for key in ("phase", "fault", "integrator")},
        **{key: counts.get(key) for key in whole},
        **{key: numbers.get(key) for key in times},
        "simulator_error_estimate": numbers.get("error_estimate"),
        "error_limit_rad": numbers.get("tolerance") or ERROR_LIMIT_RAD,
        "duration_s": float(run.seconds[-1]),
        "commands_recorded": len(run.commands.torque),
        "samples_published": published,
        "samples_recorded": recorded,
        "samples_lost": lost,
        "samples_recorded_percent": 100.0 * recorded / (recorded + lost),
        "sample_period_s": period / NANOSECONDS,
        "stamp_gaps": int(np.count_nonzero(spacing > period)),
        "samples_missing_between_stamps": between,
        "idle_states": run.idle_states,
        "foreign_states": run.foreign_states,
        "samples_measured": len(run.measured.time_ns),
        "tick_period_s": run.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(run.ticks.start_ns),
        "tick_gaps": run.ticks.gaps,
        "actuators_lag": run.scene.lags,
        "topics_missing": list(run.missing),
        "damage": list(run.signals.bag.damage),
        "unknown": measured.missing,
        "report": made_on(),
    }


def measure_timing(recording: Recording) -> Timing:
    """Measure how regular a recorded run was."""
    time, received_ns, ticks = recording.time_ns, recording.received_ns, recording.ticks
    spacing, period, missing = np.diff(time), recording.period_ns, list[str]()
    period_us = np.diff(received_ns)[spacing == period] / 1e3
    if np.any(period_us < 0.0):
        missing.append(
            "receptions are not in the order of the samples: periods are as recorded"
        )
    lost_ns = [
        time[row] + period * np.arange(1, round(spacing[row] / period))
        for row in np.flatnonzero(spacing > period).tolist()
    ]
    # Simulated time per received time, over pieces of the run.
    rows = np.unique(
        np.linspace(0, len(time) - 1, min(61, len(time))).round().astype(int)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(time[rows]) / np.diff(received_ns[rows])
    middle = 0.5 * (time[rows][1:] + time[rows][:-1]) / NANOSECONDS
    good = np.isfinite(pace) & (pace > 0.0)
    if not recording.diagnostics:
        missing.append(
            "no diagnostics: missed ticks and samples published are not known"
        )
    commands = pair_commands(recording)
    if not len(recording.commands.torque):
        missing.append("no commands are recorded: their latency is not known")
    elif commands.empty:
        missing.append("no recorded command is found among the applied torques")
    first = int(received_ns[0])
    reports = [values for _, values in recording.reports]
    reported = pd.DataFrame(reports, columns=REPORTED).replace("", None).astype(float)
    at, since = (
        [when_ns - first for when_ns, _ in recording.reports],
        received_ns - first,
    )
    reported.insert(0, "time_s", np.interp(at, since.astype(float), recording.seconds))
    delays = {
        "period": pd.Series(period_us, dtype=float),
        "command_latency": commands.received_us,
        "command_stamp_to_tick": commands.stamped_us,
    }
    numbers = {
        "commands_followed": len(commands),
        **_measure_answers(recording, commands),
    }
    for name, values in delays.items():
        described = values.describe([0.99, 0.999]).dropna()
        numbers |= {
            f"{name}_{word}_us": described.get(key) for key, word in STATISTICS.items()
        }
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

    Each has the first tick of its values from its reception on, or from a tick before
    it: the recorder may have received it a little later than the simulator.
    """
    legs, commands, ticks = ["1", "2", "3"], recording.commands, recording.ticks
    limit = recording.scene.torque_limit
    most = np.inf if limit is None else limit
    asked, applied = (
        np.clip(each.torque, -most, most) + 0.0 for each in (commands, ticks)
    )
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
    # Commands are in order of reception: the last of those that share a tick is the one
    # it took.
    found = (
        found.dropna(subset="tick")
        .sort_values("command")
        .drop_duplicates("tick", keep="last")
    )
    command, tick = (found[name].to_numpy(dtype=int) for name in ("command", "tick"))
    stamps, begins = commands.stamp_ns[command], ticks.start_ns[tick]
    age = (begins + recording.start_ns - stamps) / 1e3
    received = (step_ns[tick] - commands.received_ns[command]) / 1e3
    stamped, seconds = np.where(stamps > 0, age, np.nan), begins / NANOSECONDS
    columns = {
        "time_s": seconds,
        "received_us": received,
        "stamped_us": stamped,
        "tick": tick,
    }
    return pd.DataFrame(columns)


def _changes(torque: Array) -> NDArray[np.intp]:
    """Rows that are not the same as the row before, and the first."""
    return np.flatnonzero((np.diff(torque, axis=0, prepend=np.nan) != 0.0).any(axis=1))


def _measure_answers(
    recording: Recording, paired: DataFrame
) -> dict[str, float | None]:
    """Share of samples that a command answered, and the mean age [s] of the command of a tick."""
    commands, start_ns = recording.commands, recording.ticks.start_ns
    share = age = None
    # a torque that is commanded once and for all answers no samples
    if len(paired) > 1:
        seen = recording.measured  # what a controller receives
        if commands.stamp_ns.any():
            answered = np.isin(seen.time_ns + recording.start_ns, commands.stamp_ns)
        else:
            counts = np.searchsorted(
                commands.received_ns, seen.received_ns, side="left"
            )
            answered = np.append(np.diff(counts), 0) > 0
        # The last sample is the end of the run, which nothing answers.
        share = 100.0 * float(np.mean(answered[:-1]))
        begins = np.sort(start_ns[paired.tick])
        tick = np.searchsorted(begins, start_ns, side="right") - 1
        held = start_ns[tick >= 0] - begins[tick[tick >= 0]]
        age = float(held.mean() / NANOSECONDS) if len(held) else 0.0
    return {"samples_answered_percent": share, "command_age_mean_s": age}


@figures.styled
def draw_errors(seconds: Array, found: RunEvaluation) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    panels = {"(a) integration error, against the same torques": found.integration}
    if found.ideal is not None:
        panels["(b) sample-and-hold error, against continuous torques"] = found.ideal
    figure, grid = figures.stack(["largest difference"] * len(panels), 3.1)
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        _draw_comparison(axes, seconds, comparison)
        axes.set_title(title)
    return figure


def _draw_comparison(axes: Axes, seconds: Array, comparison: Comparison) -> None:
    """Draw the errors of a run on logarithmic axes, and the largest one of the reference."""
    least = figures.SMALLEST_SHOWN
    floor = np.fmax(comparison.own.max(axis=1), least)
    axes.fill_between(
        seconds,
        least,
        floor,
        color=GREY,
        alpha=0.3,
        linewidth=0.0,
        label="error of the reference",
    )
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, looks in zip(
        comparison.error.to_numpy().T, names, LINES, strict=False
    ):
        axes.plot(seconds, hide_zeros(values), label=name, **looks)
    axes.set_yscale("log")
    axes.set_ylim(bottom=least)
    axes.legend(fontsize=8, ncol=2, loc="lower right")


@figures.styled
def draw_overview(run: Recording, found: RunEvaluation) -> Figure:
    """Draw a run on one page; a panel without data says that it has none."""
    seconds, measured, reported = run.seconds, found.timing, found.timing.reported
    figure = Figure(figsize=(12.0, 10.4))
    grid = iter(figure.subplots(3, 2).ravel())

    def panel(title: str, values: Any, ylabel: str, xlabel: str = "time t [s]") -> Axes:
        axes: Axes = next(grid)
        axes.set(title=title, ylabel=ylabel, xlabel=xlabel)
        if xlabel == "time t [s]":
            axes.set_xlim(0.0, seconds[-1])
        if not np.isfinite(np.asarray(values)).any():
            axes.text(0.5, 0.5, "not recorded", transform=axes.transAxes, ha="center")
        return axes

    errors = found.integration.error
    axes = panel(
        "Integration error, against the same torques", errors, "largest difference"
    )
    _draw_comparison(axes, seconds, found.integration)
    axes = panel("Energy residual", found.integration.energy, "energy residual [J]")
    axes.plot(seconds, found.integration.energy, color=BLUE, linewidth=1.4)
    axes.yaxis.set_major_formatter("{x:.1e}")
    title = "Real-time factor (recorder clock), and losses"
    axes = panel(title, measured.pace, "real-time factor")
    axes.plot(measured.pace.index, measured.pace, color=BLUE, marker=".")
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    figures.widen(axes, np.append(measured.pace, 1.0), 0.04)
    missed = reported.dropna(subset="ticks_missed").set_index("time_s").ticks_missed
    total = f"{missed.iloc[-1]:g}" if len(missed) else "unknown"
    losses = {
        f"{len(measured.lost_s)} samples lost": measured.lost_s,
        f"{len(measured.gaps_s)} gaps of torques": measured.gaps_s,
        f"{total} ticks missed": missed.index[missed.diff().fillna(missed) > 0.0],
    }
    foot: Looks = {"transform": axes.get_xaxis_transform(), "linestyle": "none"}
    marks = zip(losses.items(), ("r|", "gx", "kv"), (0.03, 0.07, 0.11), strict=True)
    for (name, times), mark, height in marks:
        axes.plot(times, np.full(len(times), height), mark, label=name, **foot)
    axes.legend(fontsize=8, loc="best", ncol=3)
    label = "deviation from the nominal period [µs]"
    axes = panel(
        "Period between received samples", measured.period_us, "samples", label
    )
    axes.hist(measured.period_us - run.period_ns / 1e3, bins=80, color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    commands = measured.commands
    title = "Latency: reception of a command to the step that applies it"
    axes = panel(title, commands.received_us, "latency [µs]")
    axes.plot(commands.time_s, commands.received_us, ".", color=BLUE, markersize=3)
    axes.axhline(0.0, color=GREY, linewidth=0.9, linestyle="--")
    used = (1e-6 * reported.ticks * reported.step_mean_us).to_numpy()
    # Reports come once a second: between them, and from the start, the steps cost the
    # same.
    at = np.interp(seconds, [0.0, *reported.time_s], [0.0, *used])
    so_far = np.fmax.accumulate(errors.orientation.to_numpy())
    curves = {
        "integration error": (at if len(used) else np.full(len(at), np.nan), so_far)
    }
    for name, column in (
        ("its estimate by the simulator", "error_estimate"),
        ("hold error if torques are those of the start", "hold_error_start"),
        ("the same, of the middle", "hold_error_middle"),
    ):
        curves[name] = used, reported[column].to_numpy()
    title = "Error against computing time used, over the run"
    label = "computing time of all steps [ms]"
    axes = panel(title, used, "error of the orientation [rad]", label)
    axes.set_yscale("log")
    for (name, (times, values)), looks in zip(curves.items(), LINES, strict=False):
        marker = "" if name == "integration error" else "o"
        axes.plot(1e3 * times, hide_zeros(values), label=name, marker=marker, **looks)
    axes.legend(fontsize=8, loc="best")
    figure.suptitle(
        f"Run of {run.scene.name}: {seconds[-1]:g} s, {len(seconds)} samples"
    )
    figures.note(figure, provenance(found.summary["report"]), 200)
    return figure
