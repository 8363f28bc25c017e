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
from sst_ros.report.run import RunEvaluation, evaluate_run, summary_table

RUN_DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that the report has, too."""

PAGE, HTML = "page.png", "page.html"


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
    seconds, measured, reported = (
        run.seconds,
        evaluation.timing,
        evaluation.timing.reported,
    )
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

    errors = evaluation.integration.error
    axes = panel(
        "Integration error, against the same torques", errors, "largest difference"
    )
    _draw_comparison(axes, run, evaluation.integration)
    axes = panel(
        "Energy residual", evaluation.integration.energy, "energy residual [J]"
    )
    energy = evaluation.integration.energy
    broken = figures.break_lines(seconds, energy, run.signals.gaps())
    axes.plot(*broken, color=BLUE, linewidth=1.4)
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
    computing_time = np.interp(seconds, [0.0, *reported.time_s], [0.0, *used])
    so_far = np.fmax.accumulate(errors.orientation.to_numpy())
    curves = {
        "integration error": (
            computing_time if len(used) else np.full(len(computing_time), np.nan),
            so_far,
        )
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
    figures.note(figure, provenance(evaluation.summary["report"]), 200)
    return figure
