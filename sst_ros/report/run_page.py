# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run in files: summary, page and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros import figures
from sst_ros.figures import BLUE, GREY, LINES, Looks, hide_zeros
from sst_ros.files import write_into
from sst_ros.plot import pictures
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.results import provenance, publish, render
from sst_ros.report.run import RunEvaluation, Timing, evaluate_run, summary_table

RUN_DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that the report has, too."""

PAGE = "page.png"
HTML = "page.html"


def write_run_report(
    bag: Path, folder: Path, *, damaged: bool = False, namespace: str | None = None
) -> dict[str, Any]:
    """Evaluate a recorded run.

    Write summary.json, the page and the pictures into `folder`.

    Of a `damaged` recording what is intact is evaluated; the `namespace` is that of
    `read_bag`. The summary is returned; `summary_text` makes a short text of it,
    `summary_table` the whole. Raises InputError where the bag is no whole recording of
    a run, or `folder` cannot be written.
    """
    run = recording.read(bag, damaged=damaged, namespace=namespace)
    with write_into(folder, "report"):
        evaluation = evaluate_run(run)
        drawn, _ = pictures.draw_run(run.signals, folder, RUN_DRAWN, ["png"])
        title = f"Error against run time, {run.scene.name}"
        drawn += pictures.save(
            draw_errors(run, evaluation), title, folder, "error", ["png"]
        )
        figures.save_figure(draw_overview(run, evaluation), folder / PAGE)
        result = evaluation.summary | {
            "pictures": [path.name for path in drawn],
            "page": [PAGE, HTML],
        }
        values = {
            "s": result,
            "table": summary_table(result),
            "overview": folder / PAGE,
        }
        page = render("run.html", pictures=drawn, **values)
        publish(folder, "report", {HTML: page, "summary.json": result})
    return result


@figures.styled
def draw_errors(run: Recording, evaluation: RunEvaluation) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    panels = {"(a) integration error, against the same torques": evaluation.integration}
    if evaluation.ideal is not None:
        panels["(b) sample-and-hold error, against continuous torques"] = (
            evaluation.ideal
        )
    figure, grid = figures.stack(["largest difference"] * len(panels), 3.1)
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        _draw_comparison(axes, run, comparison)
        axes.set_title(title)
    return figure


def _draw_comparison(axes: Axes, run: Recording, comparison: Comparison) -> None:
    """Draw the errors of a run on logarithmic axes.

    Also the largest error of the reference.
    """
    gaps = run.signals.gaps()
    least = figures.SMALLEST_SHOWN
    floor = np.fmax(comparison.own.max(axis=1), least)
    seconds, floor = figures.break_lines(run.seconds, floor, gaps)
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
        _, broken = figures.break_lines(run.seconds, hide_zeros(values), gaps)
        axes.plot(seconds, broken, label=name, **looks)
    axes.set_yscale("log")
    axes.set_ylim(bottom=least)
    axes.legend(fontsize=8, ncol=2, loc="lower right")


@figures.styled
def draw_overview(run: Recording, evaluation: RunEvaluation) -> Figure:
    """Draw a run on one page; a panel without data says that it has none."""
    timing = evaluation.timing
    figure = Figure(figsize=(12.0, 10.4))
    error, energy, pace, period, latency, cost = figure.subplots(3, 2).ravel()
    _draw_integration_error(error, run, evaluation.integration)
    _draw_energy_residual(energy, run, evaluation.integration)
    _draw_pace(pace, run, timing)
    _draw_periods(period, run, timing)
    _draw_latency(latency, run, timing)
    _draw_error_over_cost(cost, run, evaluation)
    count = len(run.seconds)
    duration = run.seconds[-1]
    figure.suptitle(f"Run of {run.scene.name}: {duration:g} s, {count} samples")
    figures.note(figure, provenance(evaluation.summary["report"]), 200)
    return figure


def _label_panel(
    axes: Axes, title: str, ylabel: str, values: Any, xlabel: str = ""
) -> None:
    """Label a panel; without finite values it says that nothing was recorded."""
    axes.set(title=title, ylabel=ylabel, xlabel=xlabel)
    if not np.isfinite(np.asarray(values)).any():
        axes.text(0.5, 0.5, "not recorded", transform=axes.transAxes, ha="center")


def _label_time(
    axes: Axes, run: Recording, title: str, ylabel: str, values: Any
) -> None:
    """Label a panel over the time of a run."""
    _label_panel(axes, title, ylabel, values, "time t [s]")
    axes.set_xlim(0.0, run.seconds[-1])


def _draw_integration_error(axes: Axes, run: Recording, comparison: Comparison) -> None:
    title = "Integration error, against the same torques"
    _label_time(axes, run, title, "largest difference", comparison.error)
    _draw_comparison(axes, run, comparison)


def _draw_energy_residual(axes: Axes, run: Recording, comparison: Comparison) -> None:
    label = "energy residual [J]"
    _label_time(axes, run, "Energy residual", label, comparison.energy)
    gaps = run.signals.gaps()
    seconds, energy = figures.break_lines(run.seconds, comparison.energy, gaps)
    axes.plot(seconds, energy, color=BLUE, linewidth=1.4)
    axes.yaxis.set_major_formatter("{x:.1e}")


def _draw_pace(axes: Axes, run: Recording, timing: Timing) -> None:
    """Draw the real-time factor, and marks where something was lost or missed."""
    title = "Real-time factor (recorder clock), and losses"
    _label_time(axes, run, title, "real-time factor", timing.pace)
    axes.plot(timing.pace.index, timing.pace, color=BLUE, marker=".")
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    figures.widen(axes, np.append(timing.pace, 1.0), 0.04)
    reports = timing.reported.dropna(subset="ticks_missed").set_index("time_s")
    missed = reports.ticks_missed
    total = f"{missed.iloc[-1]:g}" if len(missed) else "unknown"
    missed_at = missed.index[missed.diff().fillna(missed) > 0.0]
    foot: Looks = {"transform": axes.get_xaxis_transform(), "linestyle": "none"}
    for times, text, marker, height in (
        (timing.lost_s, f"{len(timing.lost_s)} samples lost", "r|", 0.03),
        (timing.gaps_s, f"{len(timing.gaps_s)} gaps of torques", "gx", 0.07),
        (missed_at, f"{total} ticks missed", "kv", 0.11),
    ):
        axes.plot(times, np.full(len(times), height), marker, label=text, **foot)
    axes.legend(fontsize=8, loc="best", ncol=3)


def _draw_periods(axes: Axes, run: Recording, timing: Timing) -> None:
    title = "Period between received samples"
    label = "deviation from the nominal period [µs]"
    _label_panel(axes, title, "samples", timing.period_us, label)
    deviation = timing.period_us - run.period_ns / 1e3
    axes.hist(deviation, bins=80, color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(5))


def _draw_latency(axes: Axes, run: Recording, timing: Timing) -> None:
    title = "Latency: reception of a command to the step that applies it"
    latency = timing.commands.received_us
    _label_time(axes, run, title, "latency [µs]", latency)
    axes.plot(timing.commands.time_s, latency, ".", color=BLUE, markersize=3)
    axes.axhline(0.0, color=GREY, linewidth=0.9, linestyle="--")


def _draw_error_over_cost(
    axes: Axes, run: Recording, evaluation: RunEvaluation
) -> None:
    """Draw the error of the orientation, and estimates of it, over computing time."""
    reported = evaluation.timing.reported
    report_cost = (1e-6 * reported.ticks * reported.step_mean_us).to_numpy()
    title = "Error against computing time used, over the run"
    label = "computing time of all steps [ms]"
    ylabel = "error of the orientation [rad]"
    _label_panel(axes, title, ylabel, report_cost, label)
    axes.set_yscale("log")
    # Reports come once a second: between them, and from the start, the steps cost the
    # same.
    times = [0.0, *reported.time_s]
    sample_cost = np.interp(run.seconds, times, [0.0, *report_cost])
    if not len(report_cost):
        sample_cost = np.full(len(run.seconds), np.nan)
    error = evaluation.integration.error.orientation.to_numpy()
    largest_yet = np.fmax.accumulate(error)
    curves = [("integration error", sample_cost, largest_yet, "")]
    for column, name in (
        ("error_estimate", "its estimate by the simulator"),
        ("hold_error_start", "hold error if torques are those of the start"),
        ("hold_error_middle", "the same, of the middle"),
    ):
        curves.append((name, report_cost, reported[column].to_numpy(), "o"))
    for (name, cost, values, marker), looks in zip(curves, LINES, strict=False):
        axes.plot(1e3 * cost, hide_zeros(values), label=name, marker=marker, **looks)
    axes.legend(fontsize=8, loc="best")
