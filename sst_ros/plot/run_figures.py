# SPDX-License-Identifier: Apache-2.0
"""Figures of the report of a run: errors over run time, tracking of a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import few
from sst_ros.plot.style import GREY, LINES, SMALLEST_SHOWN, lines, positive, styled, three


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
