# SPDX-License-Identifier: Apache-2.0
"""Figures of identification: tracking before and after, and what readings of figures determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.style import BLUE, GREY, INK, SMALLEST_SHOWN, VERMILION, styled

COLOURS = (VERMILION, BLUE)
LEAST, MOST = 1e-3, 1e2
"""Range of the relative standard deviations that are shown."""


@styled
def draw_tracking_errors(runs: Mapping[str, tuple[Array, Array]], title: str) -> Figure:
    """Draw the largest tracking error of the three joints over time, a curve for each run.

    Args:
        runs: times [s], shape (n,), and errors of gamma [rad], shape (n, 3), by label.
        title: of the figure.

    """
    figure = Figure(figsize=(7.0, 3.6))
    axes = figure.subplots()
    for (label, (time, error)), colour in zip(runs.items(), COLOURS, strict=False):
        worst = np.maximum(np.abs(error).max(axis=1), SMALLEST_SHOWN)
        axes.semilogy(time, worst, color=colour, linewidth=1.6, label=label)
    drawn = [np.abs(error).max(axis=1) for _, error in runs.values()]
    axes.set_ylim(min(float(np.quantile(one, 0.05)) for one in drawn) / 3.0,
                  max(float(one.max()) for one in drawn) * 2.0)  # fmt: skip
    axes.set_xlabel("time t [s]")
    axes.set_ylabel("largest error of γ [rad]")
    axes.set_title(title, pad=22)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncol=2, frameon=False, fontsize=9,
                borderaxespad=0.1)  # fmt: skip
    return figure


@styled
def draw_determined(
    panels: Sequence[tuple[str, Sequence[str], Array]], title: str, error: str
) -> Figure:
    """Draw how well readings determine combinations of parameters, a panel for each figure read.

    Args:
        panels: title, labels of the combinations, and their relative standard deviations, rising.
            Those beyond MOST are counted below the others.
        title: of the figure.
        error: of the readings, for the axis.

    """
    known = [int(np.sum(deviations < MOST)) for _, _, deviations in panels]
    rows = [
        count + (count < len(labels)) for count, (_, labels, _) in zip(known, panels, strict=True)
    ]
    figure = Figure(figsize=(8.2, 1.2 + 0.3 * sum(rows) + 0.45 * len(rows)))
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False, height_ratios=rows)[:, 0]
    for axes, count, size, (name, labels, deviations) in zip(
        grid, known, rows, panels, strict=True
    ):
        places, shown = np.arange(count), deviations[:count]
        colours = [BLUE if value < 1.0 else GREY for value in shown]
        axes.barh(places, shown - LEAST, left=LEAST, height=0.62, log=True, color=colours)
        for place, value in zip(places.tolist(), shown.tolist(), strict=True):
            text = f"{value:.1%}" if value < 1.0 else "open"
            white = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
            axes.text(1.15 * value, place, text, va="center", fontsize=8, bbox=white)
        axes.axvline(1.0, color=INK, linewidth=0.9, linestyle="--", zorder=0)
        rest = f"{len(labels) - count} more combinations: not determined at all"
        axes.set_yticks(range(size), [*labels[:count], rest][:size], fontsize=8)
        axes.set_ylim(size - 0.5, -0.5)
        axes.grid(axis="y", visible=False)
        axes.set_title(name, fontsize=10)
        axes.set_xlim(LEAST, MOST)
    grid[-1].set_xlabel(f"relative standard deviation ({error})")
    figure.suptitle(title, fontsize=11)
    return figure
