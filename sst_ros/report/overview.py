# SPDX-License-Identifier: Apache-2.0
"""The figures of the report of a run: errors over time, and the run on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    GREY,
    LINES,
    SMALLEST_SHOWN,
    VERMILION,
    Looks,
    few,
    hide_zeros,
    scale_down,
    span,
    stack,
    styled,
    widen,
)
from sst_ros.recording.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.results import provenance
from sst_ros.report.timing import REPORTED, Timing

if TYPE_CHECKING:
    from pandas import Series

NOT_RECORDED = "not recorded"

ESTIMATES = (
    "integration error",
    "its estimate by the simulator",
    "hold error if torques are those of the start",
    "the same, of the middle",
)


@styled
def draw_errors(seconds: Array, panels: Mapping[str, Comparison]) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    figure, grid = stack(["largest difference"] * len(panels), 3.1)
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        _draw_comparison(axes, seconds, comparison, legend=axes is grid[0])
        axes.set_title(title)
    span(grid, seconds)
    return figure


def _draw_comparison(
    axes: Axes, seconds: Array, comparison: Comparison, *, legend: bool = True
) -> None:
    """Draw the errors of a run on logarithmic axes, and the largest one of the reference."""
    times, floor = few(seconds, comparison.own.max(axis=1).to_numpy())
    band: Looks = {"color": GREY, "alpha": 0.3, "linewidth": 0.0, "label": "error of the reference"}
    axes.fill_between(times, SMALLEST_SHOWN, np.fmax(floor, SMALLEST_SHOWN), **band)
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, style in zip(comparison.error.to_numpy().T, names, LINES, strict=False):
        axes.plot(*few(seconds, hide_zeros(values)), label=name, **style)
    axes.set(yscale="log", ylabel="largest difference")
    axes.set_ylim(bottom=SMALLEST_SHOWN)
    if legend and comparison.compared:
        axes.legend(fontsize=8, ncol=2, loc="lower right")


class Panel(NamedTuple):
    """A panel of the overview; `missing` is the reason why it is left out, or empty."""

    title: str
    draw: Callable[[Axes], None]
    missing: str = ""
    over_time: bool = True


def _missing(values: Array) -> str:
    """Return why a panel of values is left out; empty where some of them are known."""
    return "" if np.isfinite(values).any() else NOT_RECORDED


def _draw_curve(
    axes: Axes, seconds: Array, values: Array, label: str, around: float | None = None, **looks: Any
) -> None:
    """Draw one curve; small values in a power of ten, or with a line at what they should be."""
    shown, unit = (values, "") if around is not None else scale_down(values)
    axes.set_ylabel(label.replace("[", f"[{unit}"))
    axes.plot(*few(seconds, shown), color=BLUE, **{"linewidth": 1.4, "markersize": 4} | looks)
    if around is not None:
        axes.axhline(around, color=GREY, linewidth=0.9, linestyle="--")
        widen(axes, np.append(shown, around), 0.04)


def _draw_used(axes: Axes, estimates: Mapping[str, tuple[Array, Array]], reports: int) -> None:
    """Draw errors [rad] over computing time [s] by name; curves of `reports` points are marked."""
    axes.set_xlabel("computing time of all steps [ms]")
    axes.set_ylabel("error of the orientation [rad]")
    for (name, (used, values)), style in zip(estimates.items(), LINES, strict=False):
        marker = "o" if len(used) == reports else ""
        axes.plot(1e3 * used, hide_zeros(values), label=name, marker=marker, markersize=4, **style)
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def _draw_periods(axes: Axes, period_us: Array, nominal_us: float) -> None:
    """Draw the histogram of periods between received samples around the nominal one [us]."""
    axes.set_xlabel("deviation from the nominal period [µs]")
    axes.set_ylabel("samples")
    off = period_us - nominal_us
    reach = max(1.0, 1.05 * float(np.abs(off).max()))
    axes.hist(off, bins=np.linspace(-reach, reach, 81).tolist(), color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    numbers = {"nominal": nominal_us, "min": period_us.min(), "mean": period_us.mean()}
    numbers["max"] = period_us.max()
    for share, colour, line in ((99.0, VERMILION, "--"), (99.9, GREEN, ":")):
        name = f"p{share:g}"
        numbers[name] = np.percentile(period_us, share)
        place = numbers[name] - nominal_us
        axes.axvline(place, color=colour, linestyle=line, linewidth=1.5, label=name)
    text = "\n".join(f"{name} {value:.1f} µs" for name, value in numbers.items())
    axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", fontsize=8.5)
    axes.legend(fontsize=8, loc="upper right")


def _draw_losses(axes: Axes, losses: Mapping[str, tuple[Array, Array] | None], end: float) -> None:
    """Draw running counts of losses over time [s] by name; None for what was not recorded."""
    axes.set_ylabel("count")
    most = 0.0
    for (name, loss), style in zip(losses.items(), LINES, strict=False):
        if loss is None:
            axes.plot([], [], " ", label=f"{name}: not recorded")
            continue
        times, counts = (np.append(0.0, numbers) for numbers in loss)
        times, counts = np.append(times, end), np.append(counts, counts[-1])
        label = f"{name}: {counts[-1]:.0f}"
        axes.step(*few(times, counts), where="post", label=label, **style)
        most = max(most, counts[-1])
    axes.set_ylim(0.0, max(1.0, 1.6 * most))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")


@styled
def draw_overview(
    run: Recording, integration: Comparison, timing: Timing, summary: dict[str, Any]
) -> Figure:
    """Draw a run on one page; the footnote names what has no data."""
    panels = [*_panels(run, integration, timing)]
    shown = [panel for panel in panels if not panel.missing]
    rows = -(-len(shown) // 2)
    figure = Figure(figsize=(12.0, 3.3 * rows + 0.5))
    grid = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, panel in zip(grid, shown, strict=False):
        axes.set_title(panel.title)
        panel.draw(axes)
        if panel.over_time:
            axes.set_xlabel("time t [s]")
            axes.set_xlim(0.0, run.seconds[-1])
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    title = f"Run of {run.scene.name}: {run.seconds[-1]:g} s, {len(run.time_ns)} samples"
    figure.suptitle(title, fontsize=13)
    absent = " ".join(f"{panel.title}: {panel.missing}." for panel in panels if panel.missing)
    footnote = f"{absent}\n{provenance(summary['report'])}".strip()
    figure.supxlabel(footnote, fontsize=8, color="#555555")
    return figure


def _panels(run: Recording, integration: Comparison, timing: Timing) -> Iterator[Panel]:
    seconds, effort, reported = run.seconds, run.effort_difference, timing.reported
    losses: dict[str, tuple[Array, Array] | None] = {
        name: (np.sort(times), np.arange(1.0, len(times) + 1.0))
        for name, times in {
            "samples lost": timing.lost_s,
            "gaps between applied torques": timing.gaps_s,
        }.items()
    }
    missed = reported.dropna(subset="ticks_missed")
    counted = (missed.time_s.to_numpy(), missed.ticks_missed.to_numpy())
    losses["ticks missed"] = counted if len(missed) else None
    used = (1e-6 * reported.ticks * reported.step_mean_us).to_numpy()
    # Reports come once a second: between them, and from the start, the steps cost the same.
    at_samples = np.interp(seconds, [0.0, *reported.time_s], [0.0, *used])
    found = np.fmax.accumulate(integration.error.orientation.to_numpy())
    errors = [(at_samples if len(used) else np.full(len(seconds), np.nan), found)]
    errors += [(used, reported[name].to_numpy()) for name in REPORTED[3:]]
    drawn = any((np.isfinite(hide_zeros(y)) & np.isfinite(x)).any() for x, y in errors)
    dots: Looks = {"around": 0.0, "linestyle": "none", "marker": ".", "markersize": 3}

    def curve(
        title: str, label: str, values: Series[float], reason: str = "", **looks: Any
    ) -> Panel:
        x, y = values.index.to_numpy(), values.to_numpy()
        draw = partial(_draw_curve, seconds=x, values=y, label=label, **looks)
        return Panel(title, draw, reason or _missing(y))

    samples, commands = (table.set_index("time_s") for table in (timing.samples, timing.commands))
    yield Panel(
        "Integration error, against the same torques",
        partial(_draw_comparison, seconds=seconds, comparison=integration),
        "" if integration.compared else "nothing could be compared",
    )
    yield curve("Energy residual", "energy residual [J]", samples.energy_J)
    looks: Looks = {"around": 1.0, "marker": ".", "linewidth": 1.2}
    yield curve("Real-time factor (recorder clock)", "real-time factor", timing.pace, **looks)
    periods = partial(_draw_periods, period_us=timing.period_us, nominal_us=timing.nominal_us)
    missing = _missing(timing.period_us)
    yield Panel("Period between received samples", periods, missing, over_time=False)
    yield Panel("Cumulative losses", partial(_draw_losses, losses=losses, end=seconds[-1]))
    title = "Latency: reception of a command to the step that applies it"
    yield curve(title, "latency [µs]", commands.received_us, **dots)
    yield curve("Delay of samples", "delay, less the shortest [ms]", samples.late_us / 1e3)
    samples["effort"] = effort
    title = "Effort of joint_states against applied torque"
    same = _missing(effort) or ("" if np.nanmax(effort) else "no difference")
    yield curve(title, "largest difference [N m]", samples.effort, same)
    yield Panel(
        "Error against computing time used, over the run",
        partial(_draw_used, estimates=dict(zip(ESTIMATES, errors, strict=True)), reports=len(used)),
        "" if drawn else NOT_RECORDED,
        over_time=False,
    )
    title = "Computing time of a step, mean since the start"
    timed = reported[reported.step_mean_us > 0.0].set_index("time_s").step_mean_us
    yield curve(title, "time [µs]", timed, marker="o")
