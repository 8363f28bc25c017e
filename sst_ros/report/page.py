# SPDX-License-Identifier: Apache-2.0
"""A recorded run on one page: the overview, and an HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

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
    few,
    positive,
    scaled,
    styled,
)
from sst_ros.recording.recording import Recording
from sst_ros.report.reference import Comparison
from sst_ros.report.results import made_line
from sst_ros.report.text import table
from sst_ros.report.timing import Timing

NOT_RECORDED = "not recorded"

ESTIMATES = (
    "integration error", "its estimate by the simulator",
    "hold error if torques are those of the start", "the same, of the middle",
)  # fmt: skip

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; color: #222;
       padding: 0 1em; }
img { max-width: 100%; } pre { background: #f6f6f6; padding: 1em; overflow-x: auto;
       font-size: 12.5px; } .some { display: flex; flex-wrap: wrap; }
.some img { width: 50%; } footer { color: #666; font-size: 12px; }
"""

Estimates: TypeAlias = "Mapping[str, tuple[Array, Array]]"
Losses: TypeAlias = "Mapping[str, tuple[Array, Array] | None]"


@styled
def draw_errors(seconds: Array, panels: Mapping[str, Comparison]) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    figure = Figure(figsize=(7.0, 1.0 + 3.1 * len(panels)))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        draw_error_panel(axes, seconds, comparison)
        axes.set_title(title)
        axes.set_xlim(seconds[0], seconds[-1])
    grid[-1].set_xlabel("time t [s]")
    if next(iter(panels.values())).compared:
        grid[0].legend(loc="lower right", fontsize=8, ncol=2)
    return figure


def draw_error_panel(
    axes: Axes, seconds: Array, comparison: Comparison, *, legend: bool = False
) -> None:
    """Draw the errors of a run on logarithmic axes, and the largest one of the reference."""
    error, own = comparison.error, comparison.own
    times, floor = few(seconds, np.fmax.reduce([own.gamma, own.gamma_dot, own.orientation]))
    axes.fill_between(times, SMALLEST_SHOWN, np.fmax(floor, SMALLEST_SHOWN), color=GREY, alpha=0.3,
                      linewidth=0.0, label="error of the reference")  # fmt: skip
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    curves = (error.gamma, error.gamma_dot, error.orientation)
    for values, name, style in zip(curves, names, LINES, strict=False):
        axes.plot(*few(seconds, positive(values)), label=name, **style)
    axes.set_yscale("log")
    axes.set_ylim(bottom=SMALLEST_SHOWN)
    axes.set_ylabel("largest difference")
    if legend:
        axes.legend(fontsize=8, ncol=2, loc="lower right")


class OverviewPanel(NamedTuple):
    """A panel of the overview; `missing` is the reason why it is left out, or empty."""

    title: str
    draw: Callable[[Axes], None]
    missing: str = ""
    over_time: bool = True


@styled
def draw_overview(panels: Sequence[OverviewPanel], end: float, title: str, footnote: str) -> Figure:
    """Draw a run of `end` seconds on one page; the footnote names what has no data."""
    shown = [panel for panel in panels if not panel.missing]
    rows = -(-len(shown) // 2)
    figure = Figure(figsize=(12.0, 3.3 * rows + 0.5))
    grid = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, panel in zip(grid, shown, strict=False):
        axes.set_title(panel.title)
        panel.draw(axes)
        if panel.over_time:
            axes.set_xlabel("time t [s]")
            axes.set_xlim(0.0, end)
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    absent = [f"{panel.title}: {panel.missing}." for panel in panels if panel.missing]
    figure.suptitle(title, fontsize=13)
    figure.supxlabel("\n".join([" ".join(absent), footnote]).strip(), fontsize=8, color="#555555")
    return figure


def curve_panel(
    title: str, label: str, seconds: Array, values: Array | None, *, reason: str = "",
    marker: str = "",
) -> OverviewPanel:  # fmt: skip
    """Return a panel of one curve, small values in a power of ten; left out for a `reason`."""
    absent = reason or missing(values)
    if values is None or absent:
        return OverviewPanel(title, Axes.set_axis_off, absent)
    shown, unit = scaled(values)

    def draw(axes: Axes) -> None:
        axes.set_ylabel(label.replace("[", f"[{unit}"))
        axes.plot(*few(seconds, shown), color=BLUE, linewidth=1.4, marker=marker, markersize=4)

    return OverviewPanel(title, draw, absent)


def missing(values: Array | None) -> str:
    """Return why a panel of values is left out; empty where some of them are known."""
    return "" if values is not None and np.isfinite(values).any() else NOT_RECORDED


def draw_used(axes: Axes, estimates: Estimates, reports: int) -> None:
    """Draw errors [rad] over computing time [s] by name; curves of `reports` points are marked."""
    axes.set_xlabel("computing time of all steps [ms]")
    axes.set_ylabel("error of the orientation [rad]")
    for (name, (used, values)), style in zip(estimates.items(), LINES, strict=False):
        marker = "o" if len(used) == reports else ""
        axes.plot(1e3 * used, positive(values), label=name, marker=marker, markersize=4, **style)
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def draw_pace(axes: Axes, seconds: Array, pace: Array) -> None:
    """Draw real-time factors over time."""
    axes.set_ylabel("real-time factor")
    axes.plot(seconds, pace, color=BLUE, marker=".", linewidth=1.2)
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    reach = max(0.02, 1.1 * float(np.abs(pace - 1.0).max()))
    if reach < 0.9:
        axes.set_ylim(1.0 - reach, 1.0 + reach)


def draw_periods(axes: Axes, period_us: Array, nominal_us: float) -> None:
    """Draw the histogram of periods between received samples around the nominal one [us]."""
    axes.set_xlabel("deviation from the nominal period [µs]")
    axes.set_ylabel("samples")
    off = period_us - nominal_us
    reach = max(1.0, 1.05 * float(np.abs(off).max()))
    axes.hist(off, bins=np.linspace(-reach, reach, 81).tolist(), color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    p99, p99_9 = (float(np.percentile(off, share)) for share in (99.0, 99.9))
    axes.axvline(p99, color=VERMILION, linestyle="--", linewidth=1.5, label="p99")
    axes.axvline(p99_9, color=GREEN, linestyle=":", linewidth=1.5, label="p99.9")
    numbers = {
        "nominal": nominal_us, "min": period_us.min(), "mean": period_us.mean(),
        "max": period_us.max(), "p99": p99 + nominal_us, "p99.9": p99_9 + nominal_us,
    }  # fmt: skip
    text = "\n".join(f"{name} {value:.1f} µs" for name, value in numbers.items())
    axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", fontsize=8.5)
    axes.legend(fontsize=8, loc="upper right")


def draw_losses(axes: Axes, losses: Losses, end: float) -> None:
    """Draw running counts of losses over time [s] by name; None for what was not recorded."""
    axes.set_ylabel("count")
    most = 0.0
    for (name, loss), style in zip(losses.items(), LINES, strict=False):
        if loss is None:
            axes.plot([], [], " ", label=f"{name}: not recorded")
            continue
        times, counts = few(*loss) if len(loss[0]) else loss
        last = float(counts[-1]) if len(counts) else 0.0
        most = max(most, last)
        axes.step(np.concatenate([[0.0], times, [end]]),
                  np.concatenate([[0.0], counts, [last]]), where="post",
                  label=f"{name}: {last:.0f}", **style)  # fmt: skip
    axes.set_ylim(0.0, max(1.0, 1.6 * most))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")


def draw_latency(axes: Axes, seconds: Array, latency_us: Array) -> None:
    """Draw latencies of commands [us] over time."""
    axes.set_ylabel("latency [µs]")
    axes.plot(*few(seconds, latency_us), ".", color=BLUE, markersize=3)
    axes.set_ylim(bottom=min(0.0, 1.05 * float(latency_us.min())))


def overview(
    recording: Recording, integration: Comparison, timing: Timing, summary: dict[str, Any]
) -> Figure:
    """Draw a run on one page."""
    seconds, count = recording.seconds, len(recording.time_ns)
    losses: dict[str, tuple[Array, Array] | None] = {
        name: (np.sort(times), np.arange(1.0, len(times) + 1.0))
        for name, times in (("samples lost", timing.lost_s),
                            ("gaps between applied torques", timing.gaps_s))
    }  # fmt: skip
    at, missed, ticks, step_us, *estimates = timing.reported.T
    known, timed = np.isfinite(missed), step_us > 0.0
    losses["ticks missed"] = (at[known], missed[known]) if known.any() else None
    used = 1e-6 * ticks * step_us
    # Reports come once a second: between them, and from the start, the steps cost the same.
    at_samples = np.interp(seconds, [0.0, *at], [0.0, *used]) if len(at) else np.full(count, np.nan)
    found = np.fmax.accumulate(integration.error.orientation)
    errors = [(at_samples, found), *((used, estimate) for estimate in estimates)]
    drawn = any((np.isfinite(positive(y)) & np.isfinite(x)).any() for x, y in errors)
    latency, effort = timing.latency, recording.effort_difference
    return draw_overview(
        [
            OverviewPanel(
                "Integration error, against the same torques",
                partial(draw_error_panel, seconds=seconds, comparison=integration, legend=True),
                "" if integration.compared else "nothing could be compared",
            ),
            curve_panel("Energy residual", "energy residual [J]", seconds, timing.energy),
            OverviewPanel(
                "Real-time factor (recorder clock)",
                partial(draw_pace, seconds=timing.pace_s, pace=timing.pace), missing(timing.pace),
            ),
            OverviewPanel(
                "Period between received samples",
                partial(draw_periods, period_us=timing.period_us, nominal_us=timing.nominal_us),
                missing(timing.period_us), over_time=False,
            ),
            OverviewPanel(
                "Cumulative losses", partial(draw_losses, losses=losses, end=seconds[-1])
            ),
            OverviewPanel(
                "Latency: reception of a command to the step that applies it",
                partial(draw_latency, seconds=latency.time_s, latency_us=latency.received_us),
                missing(latency.received_us),
            ),
            curve_panel(
                "Delay of samples", "delay, less the shortest [ms]", seconds, timing.late_us / 1e3
            ),
            curve_panel(
                "Effort of joint_states against applied torque", "largest difference [N m]",
                seconds, effort,
                reason=missing(effort) or ("" if np.nanmax(effort) else "no difference"),
            ),
            OverviewPanel(
                "Error against computing time used, over the run",
                partial(
                    draw_used, estimates=dict(zip(ESTIMATES, errors, strict=True)), reports=len(at)
                ),
                "" if drawn else NOT_RECORDED, over_time=False,
            ),
            curve_panel(
                "Computing time of a step, mean since the start", "time [µs]",
                at[timed], step_us[timed], marker="o",
            ),
        ],
        seconds[-1],
        f"Run of {recording.scene.name}: {seconds[-1]:g} s, {count} samples",
        made_line(summary["report"]),
    )  # fmt: skip


def write(summary: dict[str, Any], page: Path, pictures: Sequence[Path], out: Path) -> None:
    """Write the page as HTML with all pictures inside."""
    unknown = "".join(f"<li>{html.escape(words)}</li>" for words in summary["unknown"])
    name = html.escape(str(summary["scene"]))
    parts = [
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
        f"<title>Run of {name}</title><style>{_STYLE}</style></head><body>",
        f"<h1>Run of {name}</h1>",
        _picture(
            page,
            "error, energy, real-time factor, timing, losses, latency and efforts over the run",
        ),
        f"<h2>What the recording does not contain</h2><ul>{unknown}</ul>" if unknown else "",
        f"<h2>Numbers</h2><pre>{html.escape(table(summary))}</pre>",
        "<h2>Motion</h2><div class='some'>",
        *(_picture(path, path.stem.replace("_", " ")) for path in pictures),
        f"</div><footer>{html.escape(made_line(summary['report']))}</footer></body></html>\n",
    ]
    out.write_text("\n".join(parts), encoding="utf-8")


def _picture(path: Path, words: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    return f"<img alt='{html.escape(words)}' src='data:image/png;base64,{data}'>"
