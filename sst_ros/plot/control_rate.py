# SPDX-License-Identifier: Apache-2.0
"""Figure of control rates: error against the period, and against the share of a core."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sst_ros.plot.style import BLUE, GREEN, INK, VERMILION, free_figure, note, styled
from sst_ros.plot.work_precision import MARKERS

if TYPE_CHECKING:
    from pandas import DataFrame

COLOURS = {"start": VERMILION, "middle": BLUE, "exact": GREEN}
NAMES = {
    "start": "torque at the start of the hold",
    "middle": "torque at the middle of the hold",
    "exact": "exact profile, nothing held",
}
NODES = "nodes"


@styled
def draw_control_rates(
    rows: DataFrame, orders: Mapping[str, float], title: str, footnote: str
) -> Figure:
    """Draw the largest error over the control period and over the share of a core.

    Args:
        rows: rate_Hz, method, hold, largest_rad, core_share, by.
        orders: power of the period by hold, as found.
        title: two lines.
        footnote: small print.

    """
    figure = free_figure(12.0, 6.6)
    left, right = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.87, bottom=0.235, wspace=0.06)
    loop, nodes = rows[rows.by != NODES], rows[rows.by == NODES]
    for (hold, method), group in loop.groupby(["hold", "method"], sort=False):
        marker, colour = MARKERS[method][1], COLOURS[hold]
        group = group.sort_values("rate_Hz")
        error = np.maximum(group.largest_rad.to_numpy(), 1e-17)
        given = {"color": colour, "marker": marker, "markerfacecolor": "none", "linewidth": 1.0}
        left.plot(1e3 / group.rate_Hz, error, markersize=5 + 2.5 * list(MARKERS).index(method),
                  **{**given, "linewidth": 0.0 if hold != "exact" else 1.0})  # fmt: skip
        right.plot(100.0 * group.core_share, error, markersize=7, **given)
    left.plot(1e3 / nodes.rate_Hz, nodes.largest_rad, "*", color=INK, markersize=9)
    for hold, power in (("start", 1), ("middle", 2)):
        group = loop[loop.hold == hold].sort_values("rate_Hz")
        period = 1e3 / group.rate_Hz.to_numpy()
        line = group.largest_rad.to_numpy()[0] * (period / period[0]) ** power
        left.plot(period, line, color=COLOURS[hold], linewidth=1.6, zorder=1)
        k = len(period) // 2
        left.annotate(f"slope {power} (found {orders[hold]:.3f})", (period[k], line[k]), (8, -14),
                      textcoords="offset points", color=COLOURS[hold], fontsize=9)  # fmt: skip
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
    left.set_xlabel("control period [ms]")
    left.set_ylabel("largest error of the orientation [rad]")
    right.set_xlabel("processor time of the run loop, share of a core [%]")
    handles = [Line2D([], [], color=COLOURS[hold], label=NAMES[hold]) for hold in COLOURS]
    handles += [
        Line2D([], [], color=INK, marker=MARKERS[method][1], linestyle="none",
               markerfacecolor="none", label=method) for method in loop.method.unique()
    ]  # fmt: skip
    if len(nodes):
        handles.append(Line2D([], [], color=INK, marker="*", linestyle="none", label="ROS nodes"))
    figure.legend(handles=handles, loc="center", bbox_to_anchor=(0.5, 0.12), ncol=4, fontsize=9,
                  frameon=False)  # fmt: skip
    figure.suptitle(title, fontsize=12)
    note(figure, footnote, 200)
    return figure
