# SPDX-License-Identifier: Apache-2.0
"""The picture of a study of accuracy: error over wall time, both logarithmic."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from sst_ros.plot.paper_figures import BLUE, GREEN, STYLE, VERMILION
from sst_ros.studies.accuracy import ABOVE_REFERENCE, Row, Study
from sst_ros.studies.accuracy_table import TARGET, advice, made
from sst_ros.studies.solver_grid import FIXED

PURPLE, INK = "#CC79A7", "#222222"
LOOKS = {
    "rk4": (BLUE, "o"), "dopri5": (VERMILION, "s"), "dop853": (GREEN, "^"), "rodas4": (PURPLE, "D"),
}  # fmt: skip
"""Colour and marker of each method; steps are solid and full, tolerances dashed and hollow."""


def draw(study: Study, path: Path) -> None:
    """Write the picture as PNG: orientation and rate of the actuators side by side."""
    with mpl.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(11.0, 6.4))
        left, right = figure.subplots(1, 2, sharex=True)
        figure.subplots_adjust(left=0.075, right=0.985, top=0.875, bottom=0.205, wspace=0.2)
        _panel(left, study, "orientation", study.floor)
        _panel(right, study, "gamma_dot", ABOVE_REFERENCE * study.reference.own.gamma_dot)
        left.set_ylabel("largest error of the orientation [rad]")
        right.set_ylabel("largest error of γ̇ [rad/s]")
        for axes in (left, right):
            axes.set_xlabel(f"wall time for {study.seconds:g} s of motion [ms]")
        _mark_best(left, study)
        figure.legend(handles=_legend(study), loc="center", bbox_to_anchor=(0.5, 0.095), ncol=8,
                      fontsize=8.5, frameon=False)  # fmt: skip
        figure.suptitle(f"{study.scene}: accuracy and its cost\n{advice(study)}", fontsize=12)
        note = f"Reference: {study.reference.how}. {made(study)}"
        figure.text(0.01, 0.012, "\n".join(textwrap.wrap(note, 185)), fontsize=6.5, color="#555555")
        figure.savefig(path)


def _panel(axes: Axes, study: Study, quantity: str, floor: float) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    shown = []
    for name, (colour, marker) in LOOKS.items():
        for kind in (FIXED, "tolerance"):
            rows = [r for r in study.rows if (r.method, r.kind) == (name, kind) and r.largest]
            points = [(1e3 * r.wall_s[0], getattr(r.largest, quantity)) for r in rows]
            points = [(x, y) for x, y in points if y >= floor and min(x, y) > 0.0]
            if not points:
                continue
            shown += points
            fixed = kind == FIXED
            axes.plot(*np.array(points).T, color=colour, marker=marker, markersize=6.5,
                      linestyle="-" if fixed else "--", linewidth=1.5,
                      markerfacecolor=colour if fixed else "white", markeredgecolor=colour,
                      zorder=3)  # fmt: skip
    high = 10.0 ** math.ceil(math.log10(max((y for _, y in shown), default=1.0)) + 0.01)
    low = 10.0 ** math.floor(math.log10(min((y for _, y in shown), default=high * 1e-3)) - 0.7)
    top = high * (high / low) ** 0.1
    _failures(axes, study, high, top)
    if floor > low:
        axes.axhspan(low, floor, color="#999999", alpha=0.25, linewidth=0)
        axes.text(0.02, math.sqrt(low * floor), "100 × the reference's own error: none plotted",
                  transform=axes.get_yaxis_transform(), fontsize=7.5, va="center")  # fmt: skip
    axes.set_ylim(low, top)
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _failures(axes: Axes, study: Study, high: float, top: float) -> None:
    """Show what failed in a band above everything, at the time that it took."""
    failed = [row for row in study.rows if row.failure and row.wall_s[0] > 0.0]
    if not any(row.failure for row in study.rows):
        return
    axes.axhspan(high, top, color="#f4e3d7", linewidth=0)
    told = f"failed: {sum(bool(row.failure) for row in study.rows)}"
    axes.text(0.99, math.sqrt(high * top), told, transform=axes.get_yaxis_transform(), ha="right",
              va="center", fontsize=8.5)  # fmt: skip
    for row in failed:
        colour, marker = LOOKS[row.method]
        at = 1e3 * row.wall_s[0], math.sqrt(high * top)
        axes.plot(*at, marker, color=colour, markerfacecolor="none", markersize=6.5, zorder=3)
        axes.plot(*at, "x", color=INK, markersize=5, zorder=4)


def _mark_best(axes: Axes, study: Study) -> None:
    best: Row | None = study.best(TARGET)
    if best is None or best.largest is None:
        return
    axes.axhline(TARGET, color=INK, linewidth=0.9, linestyle=":")
    y = max(best.largest.orientation, study.floor)
    axes.plot(1e3 * best.wall_s[0], y, "o", markersize=14, markerfacecolor="none",
              markeredgecolor=INK, markeredgewidth=1.4, zorder=5)  # fmt: skip


def _legend(study: Study) -> list[Line2D]:
    used = {row.method for row in study.rows}
    handles = [
        Line2D([], [], color=colour, marker=marker, label=name, linewidth=1.5)
        for name, (colour, marker) in LOOKS.items() if name in used
    ]  # fmt: skip
    handles.append(Line2D([], [], color=INK, marker="o", label="fixed steps (full)"))
    handles.append(Line2D([], [], color=INK, marker="o", markerfacecolor="white", linestyle="--",
                          label="tolerance (hollow)"))  # fmt: skip
    if any(row.failure for row in study.rows):
        handles.append(Line2D([], [], color=INK, marker="x", linestyle="none", label="failed"))
    if study.best(TARGET) is not None:
        handles.append(Line2D([], [], color=INK, marker="o", linestyle=":", markersize=11,
                              markerfacecolor="none", label="advice for 1e-9 rad"))  # fmt: skip
    return handles
