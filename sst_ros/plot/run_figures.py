# SPDX-License-Identifier: Apache-2.0
"""Figures of the report of a run: errors over run time, and the overview on one page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import few
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    GREY,
    LINES,
    SMALLEST_SHOWN,
    VERMILION,
    positive,
    scaled,
    styled,
)

NOT_RECORDED = "not recorded"

Estimates: TypeAlias = "Mapping[str, tuple[Array, Array]]"
Losses: TypeAlias = "Mapping[str, tuple[Array, Array] | None]"


class ErrorCurves(NamedTuple):
    """Errors at each sample, shape (n,): gamma [rad], gamma_dot [rad/s], orientation [rad].

    `floor` is the largest error of the reference itself.
    """

    gamma: Array
    gamma_dot: Array
    orientation: Array
    floor: Array


@styled
def draw_errors(seconds: Array, panels: Mapping[str, ErrorCurves]) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    figure = Figure(figsize=(7.0, 1.0 + 3.1 * len(panels)))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, error) in zip(grid, panels.items(), strict=True):
        draw_error_panel(axes, seconds, error)
        axes.set_title(title)
        axes.set_xlim(seconds[0], seconds[-1])
    grid[-1].set_xlabel("time t [s]")
    if np.isfinite(next(iter(panels.values())).gamma).any():
        grid[0].legend(loc="lower right", fontsize=8, ncol=2)
    return figure


def draw_error_panel(
    axes: Axes, seconds: Array, error: ErrorCurves, *, legend: bool = False
) -> None:
    """Draw the errors of a run on logarithmic axes."""
    times, floor = few(seconds, error.floor)
    axes.fill_between(times, SMALLEST_SHOWN, np.fmax(floor, SMALLEST_SHOWN), color=GREY, alpha=0.3,
                      linewidth=0.0, label="error of the reference")  # fmt: skip
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, style in zip(error[:3], names, LINES, strict=False):
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
