# SPDX-License-Identifier: Apache-2.0
"""Figures of the report of a run: error over run time, torques, and an overview on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import few
from sst_ros.plot.joints import held
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    GREY,
    LINES,
    SMALLEST_SHOWN,
    VERMILION,
    lines,
    positive,
    styled,
    three,
)
from sst_ros.recording.time_series import Integers


class ErrorCurves(NamedTuple):
    """Errors at each sample, shape (n,): gamma [rad], gamma_dot [rad/s], orientation [rad].

    `floor` is the largest error of the reference itself.
    """

    gamma: Array
    gamma_dot: Array
    orientation: Array
    floor: Array


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
        used_s: computing time of the steps so far [s] at each report of the simulator, shape (r,).
        estimates: errors of the orientation [rad] by name, shape (r,) each.
        reported_s, step_us: times of the reports [s], mean time of a step so far [us].

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
    used_s: Array
    estimates: Mapping[str, Array]
    reported_s: Array
    step_us: Array


@styled
def draw_torques(start_ns: Integers, end_ns: Integers, torque: Array) -> Figure:
    """Draw the torques of ticks [N m], shape (n, 3), as they were held."""
    figure = Figure(figsize=(7.0, 4.2))
    axes = figure.subplots()
    lines(axes, *few(*held(start_ns, end_ns, torque)), three("τ"), least_span=0.1)
    axes.set_xlabel("time t [s]")
    axes.set_ylabel("torque τ [N m]")
    return figure


@styled
def draw_errors(seconds: Array, panels: Mapping[str, ErrorCurves]) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    figure = Figure(figsize=(7.0, 1.0 + 3.1 * len(panels)))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, error) in zip(grid, panels.items(), strict=True):
        _errors(axes, seconds, error)
        axes.set_title(title)
        axes.set_xlim(seconds[0], seconds[-1])
    grid[-1].set_xlabel("time t [s]")
    if np.isfinite(next(iter(panels.values())).gamma).any():
        grid[0].legend(loc="lower right", fontsize=8, ncol=2)
    return figure


@styled
def draw_overview(run: Overview, title: str, footnote: str) -> Figure:
    """Draw a run on one page with ten panels."""
    figure = Figure(figsize=(12.0, 16.6))
    grid = figure.subplots(5, 2)
    grid[0, 0].set_title("Integration error, against the same torques")
    _errors(grid[0, 0], run.seconds, run.error)
    if np.isfinite(run.error.gamma).any():
        grid[0, 0].legend(fontsize=8, ncol=2, loc="lower right")
    else:
        _unknown(grid[0, 0], "nothing could be compared")
    _curve(grid[0, 1], run.seconds, run.energy, "Energy residual", "energy residual [J]")
    _pace(grid[1, 0], run)
    _periods(grid[1, 1], run)
    _losses(grid[2, 0], run)
    _latency(grid[2, 1], run)
    _curve(grid[3, 0], run.seconds, run.late_ms, "Delay of samples",
           "delay, less the shortest [ms]")  # fmt: skip
    _curve(grid[3, 1], run.seconds, run.effort, "Effort of joint_states against applied torque",
           "largest difference [N m]", zero="none")  # fmt: skip
    _used(grid[4, 0], run)
    known = np.isfinite(run.step_us)
    step_us = run.step_us[known] if known.any() else None
    _curve(grid[4, 1], run.reported_s[known], step_us, "Computing time of a step, by the simulator",
           "mean so far [µs]", zero="none", marker="o")  # fmt: skip
    for axes in (*grid[:4, 0], *grid[[0, 2, 3, 4], 1]):
        axes.set_xlabel("time t [s]")
        axes.set_xlim(0.0, run.seconds[-1])
    figure.suptitle(title, fontsize=13)
    figure.supxlabel(footnote, fontsize=7, color="#555555")
    return figure


def _errors(axes: Axes, seconds: Array, error: ErrorCurves) -> None:
    times, floor = few(seconds, error.floor)
    axes.fill_between(times, SMALLEST_SHOWN, np.fmax(floor, SMALLEST_SHOWN), color=GREY, alpha=0.3,
                      linewidth=0.0, label="error of the reference")  # fmt: skip
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, style in zip(error[:3], names, LINES, strict=False):
        axes.plot(*few(seconds, positive(values)), label=name, **style)
    axes.set_yscale("log")
    axes.set_ylim(bottom=SMALLEST_SHOWN)
    axes.set_ylabel("largest difference")


def _curve(
    axes: Axes,
    seconds: Array,
    values: Array | None,
    title: str,
    label: str,
    zero: str = "",
    marker: str = "",
) -> None:
    axes.set_title(title)
    axes.set_ylabel(label)
    if values is None or not np.isfinite(values).any():
        _unknown(axes)
        return
    axes.plot(*few(seconds, values), color=BLUE, linewidth=1.4, marker=marker, markersize=4)
    if zero:
        axes.set_ylim(bottom=0.0)
        if not np.nanmax(values):
            axes.set_ylim(0.0, 1.0)
            _unknown(axes, zero)


def _used(axes: Axes, run: Overview) -> None:
    axes.set_title("Error against computing time used, at the reports of the simulator")
    axes.set_xlabel("computing time of the steps so far [ms]")
    axes.set_ylabel("error of the orientation [rad]")
    some = False
    for (name, values), style in zip(run.estimates.items(), LINES, strict=False):
        shown = positive(values)
        if (np.isfinite(shown) & np.isfinite(run.used_s)).any():
            some = True
            axes.plot(1e3 * run.used_s, shown, label=name, marker="o", markersize=4, **style)
    if not some:
        _unknown(axes)
        return
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def _pace(axes: Axes, run: Overview) -> None:
    axes.set_title("Real-time factor (recorder clock)")
    axes.set_ylabel("real-time factor")
    if not len(run.pace):
        _unknown(axes)
        return
    axes.plot(run.pace_s, run.pace, color=BLUE, marker=".", linewidth=1.2)
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    reach = max(0.02, 1.1 * float(np.abs(run.pace - 1.0).max()))
    if reach < 0.9:
        axes.set_ylim(1.0 - reach, 1.0 + reach)


def _periods(axes: Axes, run: Overview) -> None:
    axes.set_title("Period between received samples")
    axes.set_xlabel("deviation from the nominal period [µs]")
    axes.set_ylabel("samples")
    if not len(run.period_us):
        _unknown(axes)
        return
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
    axes.set_title("Cumulative losses")
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
    axes.set_title("Latency: reception of a command to the step that applies it")
    axes.set_ylabel("latency [µs]")
    if not len(run.latency_s):
        _unknown(axes)
        return
    axes.plot(*few(run.latency_s, run.latency_us), ".", color=BLUE, markersize=3)
    axes.set_ylim(bottom=min(0.0, 1.05 * float(run.latency_us.min())))


def _unknown(axes: Axes, words: str = "unknown") -> None:
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", color=GREY, fontsize=12)


@styled
def draw_tracking(
    time: Array,
    desired: Array,
    error: Array,
    orientation_error: Array,
    torques: Sequence[Array],
    title: str,
) -> Figure:
    """Draw a run that tracked a reference: motion, error, error on a logarithmic axis, torques.

    Args:
        time: of the samples [s], shape (n,).
        desired: gamma of the reference [rad], shape (n, 3).
        error: desired less measured gamma [rad], shape (n, 3).
        orientation_error: [rad], shape (n,).
        torques: feedforward and feedback [N m], shape (n, 3) each.
        title: of the figure.

    """
    figure = Figure(figsize=(11.0, 7.4))
    (motion, errors), (growth, torque) = figure.subplots(2, 2, sharex=True)
    motion.set_title("Motion: measured, over the desired one (grey)")
    motion.set_ylabel("γ [deg]")
    for values in np.degrees(desired).T:
        motion.plot(time, values, color=GREY, linewidth=5.0, alpha=0.4)
    lines(motion, time, np.degrees(desired - error), three("γ"))
    errors.set_title("Tracking error")
    errors.set_ylabel("γ desired − γ [rad]")
    lines(errors, time, error, three("γ"))
    growth.set_title("Error against run time")
    growth.set_ylabel("error [rad]")
    worst = np.abs(error).max(axis=1)
    curves = {"largest of γ": worst, "orientation": orientation_error,
              "running maximum of γ": np.maximum.accumulate(worst)}  # fmt: skip
    for (name, values), style in zip(curves.items(), LINES, strict=False):
        shown = positive(values)
        if np.isfinite(shown).any():
            growth.plot(time, shown, label=name, **style)
    growth.set_yscale("log")
    growth.legend(fontsize=8, loc="best")
    torque.set_title("Torques: feedforward, and feedback (thin)")
    torque.set_ylabel("torque [N m]")
    lines(torque, time, torques[0], three("τ"))
    for values, style in zip(torques[1].T, LINES, strict=False):
        torque.plot(time, values, color=style["color"], linewidth=0.8)
    for axes in (growth, torque):
        axes.set_xlabel("time of the run t [s]")
    figure.suptitle(title, fontsize=12)
    return figure
