# SPDX-License-Identifier: Apache-2.0
"""Overview of a run on one page: errors, energy, timing, losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import few
from sst_ros.plot.run_figures import ErrorCurves, draw_error_panel
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    GREY,
    LINES,
    VERMILION,
    positive,
    scaled,
    styled,
)

NOT_RECORDED = "not recorded"


class Overview(NamedTuple):
    """What the overview of a run shows; an empty array, or None, where it is not known.

    Attributes:
        seconds: times of the samples [s], shape (n,).
        error: integration error.
        energy: energy residual [J], shape (n,).
        pace_s, pace: times [s] and real-time factors.
        period_us, nominal_us: periods between received samples, and the nominal one [us].
        losses: times [s] and running counts by name; None for what was not recorded.
        latency_s, latency_us: times [s] and latencies of commands [us].
        late_ms: delay of each sample [ms], shape (n,).
        effort: difference of effort and applied torque [N m], shape (n,).
        estimates: computing time of all steps [s] and errors of the orientation [rad] by name: the
            integration error at each sample, estimates at each report of the simulator.
        reported_s, step_us: times of the reports [s], mean time of a step since the start [us].

    """

    seconds: Array
    error: ErrorCurves
    energy: Array | None
    pace_s: Array
    pace: Array
    period_us: Array
    nominal_us: float
    losses: Mapping[str, tuple[Array, Array] | None]
    latency_s: Array
    latency_us: Array
    late_ms: Array
    effort: Array
    estimates: Mapping[str, tuple[Array, Array]]
    reported_s: Array
    step_us: Array


class _Panel(NamedTuple):
    """A panel of the overview; `missing` is the reason why it is left out, or empty."""

    title: str
    draw: Callable[[Axes], None]
    missing: str = ""
    over_time: bool = True


@styled
def draw_overview(run: Overview, title: str, footnote: str) -> Figure:
    """Draw a run on one page; what has no data is named in the footnote instead."""
    panels = _panels(run)
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
    absent = [f"{panel.title}: {panel.missing}." for panel in panels if panel.missing]
    figure.suptitle(title, fontsize=13)
    figure.supxlabel("\n".join([" ".join(absent), footnote]).strip(), fontsize=8, color="#555555")
    return figure


def _panels(run: Overview) -> list[_Panel]:
    """List the panels in their order on the page."""
    late = "delay, less the shortest [ms]"
    effort = "largest difference [N m]"
    known = run.step_us > 0.0
    reported_s, step_us = run.reported_s[known], run.step_us[known]
    used = any(
        (np.isfinite(positive(values)) & np.isfinite(used)).any()
        for used, values in run.estimates.values()
    )
    return [
        _Panel(
            "Integration error, against the same torques",
            lambda axes: draw_error_panel(axes, run.seconds, run.error, legend=True),
            "" if np.isfinite(run.error.gamma).any() else "nothing could be compared",
        ),
        _Panel(
            "Energy residual",
            lambda axes: _curve(axes, run.seconds, run.energy, "energy residual [J]"),
            _missing(run.energy),
        ),
        _Panel("Real-time factor (recorder clock)", partial(_pace, run=run), _missing(run.pace)),
        _Panel(
            "Period between received samples", partial(_periods, run=run),
            _missing(run.period_us), over_time=False,
        ),
        _Panel("Cumulative losses", partial(_losses, run=run)),
        _Panel(
            "Latency: reception of a command to the step that applies it",
            partial(_latency, run=run), _missing(run.latency_us),
        ),
        _Panel(
            "Delay of samples", lambda axes: _curve(axes, run.seconds, run.late_ms, late),
            _missing(run.late_ms),
        ),
        _Panel(
            "Effort of joint_states against applied torque",
            lambda axes: _curve(axes, run.seconds, run.effort, effort),
            _missing(run.effort) or ("" if np.nanmax(run.effort) else "no difference"),
        ),
        _Panel(
            "Error against computing time used, over the run",
            partial(_used, run=run), "" if used else NOT_RECORDED, over_time=False,
        ),
        _Panel(
            "Computing time of a step, mean since the start",
            lambda axes: _curve(axes, reported_s, step_us, "time [µs]", marker="o"),
            _missing(step_us),
        ),
    ]  # fmt: skip


def _missing(values: Array | None) -> str:
    return "" if values is not None and np.isfinite(values).any() else NOT_RECORDED


def _curve(axes: Axes, seconds: Array, values: Array | None, label: str, marker: str = "") -> None:
    assert values is not None
    shown, unit = scaled(values)
    axes.set_ylabel(label.replace("[", f"[{unit}"))
    axes.plot(*few(seconds, shown), color=BLUE, linewidth=1.4, marker=marker, markersize=4)


def _used(axes: Axes, run: Overview) -> None:
    axes.set_xlabel("computing time of all steps [ms]")
    axes.set_ylabel("error of the orientation [rad]")
    for (name, (used, values)), style in zip(run.estimates.items(), LINES, strict=False):
        marker = "o" if len(used) == len(run.reported_s) else ""
        axes.plot(1e3 * used, positive(values), label=name, marker=marker, markersize=4, **style)
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def _pace(axes: Axes, run: Overview) -> None:
    axes.set_ylabel("real-time factor")
    axes.plot(run.pace_s, run.pace, color=BLUE, marker=".", linewidth=1.2)
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    reach = max(0.02, 1.1 * float(np.abs(run.pace - 1.0).max()))
    if reach < 0.9:
        axes.set_ylim(1.0 - reach, 1.0 + reach)


def _periods(axes: Axes, run: Overview) -> None:
    axes.set_xlabel("deviation from the nominal period [µs]")
    axes.set_ylabel("samples")
    off = run.period_us - run.nominal_us
    reach = max(1.0, 1.05 * float(np.abs(off).max()))
    axes.hist(off, bins=np.linspace(-reach, reach, 81).tolist(), color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    p99, p99_9 = (float(np.percentile(off, share)) for share in (99.0, 99.9))
    axes.axvline(p99, color=VERMILION, linestyle="--", linewidth=1.5, label="p99")
    axes.axvline(p99_9, color=GREEN, linestyle=":", linewidth=1.5, label="p99.9")
    numbers = {
        "nominal": run.nominal_us, "min": run.period_us.min(), "mean": run.period_us.mean(),
        "max": run.period_us.max(), "p99": p99 + run.nominal_us, "p99.9": p99_9 + run.nominal_us,
    }  # fmt: skip
    text = "\n".join(f"{name} {value:.1f} µs" for name, value in numbers.items())
    axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", fontsize=8.5)
    axes.legend(fontsize=8, loc="upper right")


def _losses(axes: Axes, run: Overview) -> None:
    axes.set_ylabel("count")
    most = 0.0
    for (name, loss), style in zip(run.losses.items(), LINES, strict=False):
        if loss is None:
            axes.plot([], [], " ", label=f"{name}: not recorded")
            continue
        times, counts = few(*loss) if len(loss[0]) else loss
        last = float(counts[-1]) if len(counts) else 0.0
        most = max(most, last)
        axes.step(np.concatenate([[0.0], times, run.seconds[-1:]]),
                  np.concatenate([[0.0], counts, [last]]), where="post",
                  label=f"{name}: {last:.0f}", **style)  # fmt: skip
    axes.set_ylim(0.0, max(1.0, 1.6 * most))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")


def _latency(axes: Axes, run: Overview) -> None:
    axes.set_ylabel("latency [µs]")
    axes.plot(*few(run.latency_s, run.latency_us), ".", color=BLUE, markersize=3)
    axes.set_ylim(bottom=min(0.0, 1.05 * float(run.latency_us.min())))
