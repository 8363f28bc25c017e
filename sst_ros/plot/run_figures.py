# SPDX-License-Identifier: Apache-2.0
"""Figures of the report of a run: errors over run time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.downsampling import few
from sst_ros.plot.style import GREY, LINES, SMALLEST_SHOWN, positive, styled


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
