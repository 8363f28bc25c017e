# SPDX-License-Identifier: Apache-2.0
"""Figures of the methods: errors against their cost, stable steps."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from sst_ros.integration.methods import METHODS
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    VERMILION,
    Looks,
    free_figure,
    legend,
    note,
    styled,
)

if TYPE_CHECKING:
    from pandas import DataFrame


MARKERS = {
    "rk4": (BLUE, "o"),
    "dopri5": (VERMILION, "s"),
    "dop853": (GREEN, "^"),
    "rodas4": (PURPLE, "D"),
    "gauss": (ORANGE, "v"),
}
"""Colour and marker of each method; steps are solid and full, tolerances dashed and hollow."""

FIXED = "fixed steps"


@styled
def draw_work_precision(
    rows: DataFrame,
    *,
    floors: tuple[float, float],
    seconds: float,
    best: Mapping[float, tuple[float, float]],
    title: str,
    footnote: str,
) -> Figure:
    """Draw the largest errors of orientation and actuator rates side by side.

    Args:
        rows: the solver grid: method, kind, wall_min_s, largest_orientation_rad,
            largest_gamma_dot_rad_per_s, failure.
        floors: smallest errors of both that are drawn [rad], [rad/s].
        seconds: time span of the run [s].
        best: wall time [ms] and error [rad] of the fastest setting for errors of the orientation
            [rad], which are marked.
        title: two lines.
        footnote: small print.

    """
    figure = free_figure(11.0, 6.4)
    panels = figure.subplots(1, 2, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.875, bottom=0.205, wspace=0.2)
    quantities = ("largest_orientation_rad", "largest_gamma_dot_rad_per_s")
    labels = ("largest error of the orientation [rad]", "largest error of γ̇ [rad/s]")
    for axes, quantity, floor, label in zip(panels, quantities, floors, labels, strict=True):
        _draw_grid(axes, rows, quantity, floor)
        axes.set_ylabel(label)
        axes.set_xlabel(f"wall time for {seconds:g} s of motion [ms]")
    ring = {"markersize": 14, "markerfacecolor": "none", "markeredgewidth": 1.4, "zorder": 5}
    for target, place in best.items():
        panels[0].axhline(target, color=INK, linewidth=0.9, linestyle=":")
        panels[0].plot(*place, "o", markeredgecolor=INK, **ring)
    below: Looks = {"loc": "center", "bbox_to_anchor": (0.5, 0.095), "ncol": 9}
    figure.legend(handles=[*_handles(rows, best)], fontsize=8, frameon=False, **below)
    figure.suptitle(title, fontsize=12)
    note(figure, footnote, 185)
    return figure


def _entry(label: str, marker: str, color: str = INK, **looks: Any) -> Line2D:
    """Return an entry of a legend."""
    return Line2D([], [], label=label, marker=marker, color=color, **looks)


def _handles(rows: DataFrame, targets: Collection[float]) -> Iterator[Line2D]:
    for name, (colour, marker) in MARKERS.items():
        if name in set(rows.method):
            yield _entry(name, marker, colour, linewidth=1.5)
    yield _entry("fixed steps (full)", "o")
    yield _entry("tolerance (hollow)", "o", markerfacecolor="white", linestyle="--")
    if (rows.failure != "").any():
        yield _entry("failed", "x", linestyle="none")
    if targets:
        name = f"fastest for {', '.join(f'{target:.0e}' for target in targets)} rad"
        yield _entry(name, "o", linestyle=":", markersize=11, markerfacecolor="none")


@styled
def draw_summary(rows: DataFrame, footnote: str) -> Figure:
    """Draw the time of the fastest setting for each error, a line of markers for each scene.

    Args:
        rows: scene, target [rad], method, share (wall time per time of the motion).
        footnote: small print.

    """
    names = list(dict.fromkeys(rows.scene))
    figure = free_figure(9.0, 1.7 + 0.36 * len(names))
    axes = figure.subplots()
    inch = 1.0 / figure.get_figheight()
    figure.subplots_adjust(left=0.17, right=0.98, top=1.0 - 0.45 * inch, bottom=1.05 * inch)
    sizes = {t: 5.5 + 3.0 * k for k, t in enumerate(sorted(set(rows.target), reverse=True))}
    hollow: Looks = {"markerfacecolor": "none", "linestyle": "none"}
    for row in rows.itertuples():
        colour, marker = MARKERS[row.method]
        place = 100.0 * row.share, names.index(row.scene)
        looks: Looks = {"color": colour, "markersize": sizes[row.target], "markeredgewidth": 1.5}
        axes.plot(*place, marker, **looks, **hollow)
    axes.axvline(100.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("wall time of the integration per time of the motion [%]")
    title = "Fastest setting for an error of the orientation"
    figure.suptitle(title, fontsize=11, x=0.02, ha="left")
    used = {name: look for name, look in MARKERS.items() if name in set(rows.method)}
    handles = [_entry(name, mark, colour, **hollow) for name, (colour, mark) in used.items()]
    for target, size in sizes.items():
        handles.append(_entry(f"{target:.0e} rad", "o", markersize=size, **hollow))
    legend(axes, handles=handles, ncol=5)
    note(figure, footnote, 150)
    return figure


def _draw_grid(axes: Axes, rows: DataFrame, quantity: str, floor: float) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    drawn = rows[(rows[quantity] >= floor) & (rows[quantity] > 0.0) & (rows.wall_min_s > 0.0)]
    for (name, kind), group in drawn.groupby(["method", "kind"], sort=False):
        colour, marker = MARKERS[name]
        face, line = (colour, "-") if kind == FIXED else ("white", "--")
        looks: Looks = {"marker": marker, "linestyle": line, "markerfacecolor": face, "zorder": 3}
        x, y = 1e3 * group.wall_min_s, group[quantity]
        axes.plot(x, y, color=colour, markersize=6.5, linewidth=1.5, **looks)
    errors: Any = drawn[quantity]
    high = 10.0 ** math.ceil(math.log10(errors.max() if len(errors) else 1.0) + 0.01)
    low = 10.0 ** math.floor(math.log10(errors.min() if len(errors) else high * 1e-3) - 0.7)
    top = high * (high / low) ** 0.1
    across: Looks = {"transform": axes.get_yaxis_transform(), "va": "center"}
    failed = rows[rows.failure != ""]
    if len(failed):  # in a band above everything, at their wall time
        axes.axhspan(high, top, color="#f4e3d7", linewidth=0)
        middle = math.sqrt(high * top)
        axes.text(0.99, middle, f"failed: {len(failed)}", ha="right", fontsize=8.5, **across)
        for name, wall in zip(failed.method, 1e3 * failed.wall_min_s, strict=True):
            colour, marker = MARKERS[name]
            x = wall if wall > 0.0 else np.nan
            hollow: Looks = {"markerfacecolor": "none", "markersize": 6.5}
            axes.plot(x, middle, marker, color=colour, zorder=3, **hollow)
            axes.plot(x, middle, "x", color=INK, markersize=5, zorder=4)
    if floor > low:
        axes.axhspan(low, floor, color="#999999", alpha=0.25, linewidth=0)
        text = "100 × the reference's own error: none plotted"
        axes.text(0.02, math.sqrt(low * floor), text, fontsize=7.5, **across)
    axes.set_ylim(low, top)
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def draw_stability(steps: DataFrame, runs: DataFrame, title: str, footnote: str) -> Figure:
    """Draw eigenvalues and stable steps along a motion, and how runs with other numbers ended.

    Args:
        steps: t_s, decay, oscillation [1/s], and the longest stable step of each method [s].
        runs: name, passed, result, error and estimate [rad], nan where there is none.
        title: of the figure.
        footnote: small print.

    """
    figure = free_figure(11.0, 5.2 + 0.36 * len(runs))
    inch = 1.0 / figure.get_figheight()
    middle = (0.36 * len(runs) + 1.6) * inch
    edges = {"left": 0.075, "right": 0.985, "top": 1.0 - 0.75 * inch, "bottom": middle}
    panels: Any = figure.add_gridspec(1, 2, wspace=0.2, **edges).subplots()
    left, right = panels
    for name, colour, line in (("decay", BLUE, "-"), ("oscillation", VERMILION, "--")):
        values = np.where(steps[name] > 0.0, steps[name], np.nan)
        left.plot(steps.t_s, values, line, color=colour, linewidth=1.8, label=name)
    left.set_ylabel("fastest rate of the eigenvalues [1/s]")
    free = [name for name in METHODS if not np.isfinite(steps[name]).any()]
    for name in (name for name in METHODS if name not in free):
        values = np.where(np.isfinite(steps[name]), steps[name], np.nan)
        right.plot(steps.t_s, values, color=MARKERS[name][0], linewidth=1.8, label=name)
    right.plot([], [], " ", label=f"{', '.join(free)}: every step")
    right.set_ylabel("longest stable step [s]")
    for axes in (left, right):
        axes.set_yscale("log")
        axes.set_xlabel("time t [s]")
        legend(axes)
    edges = {"left": 0.11, "right": 0.985, "top": middle - 0.85 * inch, "bottom": 0.85 * inch}
    _draw_ends(figure.add_subplot(figure.add_gridspec(1, 1, **edges)[0, 0]), runs)
    figure.suptitle(title, fontsize=12)
    note(figure, footnote, 185)
    return figure


def _draw_ends(axes: Axes, runs: DataFrame) -> None:
    """Draw error and estimate of each run, with how it ended beside them."""
    axes.set_xscale("log")
    axes.set_xlim(1e-17, 1e3)
    for place, run in enumerate(runs.itertuples()):
        colour = GREEN if run.passed else VERMILION
        error, estimate = (max(value, 2e-17) for value in (run.error, run.estimate))
        axes.plot([error, estimate], [place, place], color=colour, linewidth=1.0)
        axes.plot(estimate, place, "|", color=colour, markersize=13, markeredgewidth=2.0)
        axes.plot(error, place, "o", color=colour, markersize=6)
        text = run.result if len(run.result) < 68 else f"{run.result[:66]} ..."
        words = text if run.passed else f"FAILED: {text}"
        axes.text(3e-7, place, words, va="center", fontsize=8, color=INK)
    axes.set_yticks(range(len(runs)), list(runs.name))
    axes.set_ylim(len(runs) - 0.5, -0.5)
    axes.set_xticks([1e-16, 1e-14, 1e-12, 1e-10, 1e-8])
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("error of the orientation (dot), its estimate (bar) [rad]", loc="left")
