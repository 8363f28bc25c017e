# SPDX-License-Identifier: Apache-2.0
"""Figures of the methods: errors against their cost, regions of absolute stability."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    VERMILION,
    free_figure,
    note,
    styled,
)

if TYPE_CHECKING:
    from pandas import DataFrame


MARKERS = {
    "rk4": (BLUE, "o"), "dopri5": (VERMILION, "s"), "dop853": (GREEN, "^"), "rodas4": (PURPLE, "D"),
    "gauss": (ORANGE, "v"),
}  # fmt: skip
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
        _panel(axes, rows, quantity, floor)
        axes.set_ylabel(label)
        axes.set_xlabel(f"wall time for {seconds:g} s of motion [ms]")
    for target, place in best.items():
        panels[0].axhline(target, color=INK, linewidth=0.9, linestyle=":")
        panels[0].plot(*place, "o", markersize=14, markerfacecolor="none", markeredgecolor=INK,
                       markeredgewidth=1.4, zorder=5)  # fmt: skip
    figure.legend(handles=_legend(rows, best), loc="center",
                  bbox_to_anchor=(0.5, 0.095), ncol=9, fontsize=8, frameon=False)  # fmt: skip
    figure.suptitle(title, fontsize=12)
    note(figure, footnote, 185)
    return figure


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
    high = 1.0 / (1.7 + 0.36 * len(names))
    figure.subplots_adjust(left=0.17, right=0.98, top=1.0 - 0.45 * high, bottom=1.05 * high)
    targets = sorted(set(rows.target), reverse=True)
    for row in rows.itertuples():
        colour, marker = MARKERS[row.method]
        size = 5.5 + 3.0 * targets.index(row.target)
        axes.plot(100.0 * row.share, names.index(row.scene), marker, color=colour, markersize=size,
                  markerfacecolor="none", markeredgewidth=1.5)  # fmt: skip
    axes.axvline(100.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("wall time of the integration per time of the motion [%]")
    axes.set_title("Fastest setting for an error of the orientation")
    handles = [Line2D([], [], color=colour, marker=marker, linestyle="none", label=name,
                      markerfacecolor="none") for name, (colour, marker) in MARKERS.items()
               if name in set(rows.method)]  # fmt: skip
    handles += [Line2D([], [], color=INK, marker="o", linestyle="none", markerfacecolor="none",
                       markersize=5.5 + 3.0 * k, label=f"{target:.0e} rad")
                for k, target in enumerate(targets)]  # fmt: skip
    axes.legend(handles=handles, fontsize=8, loc="lower right", framealpha=0.9)
    note(figure, footnote, 150)
    return figure


def _panel(axes: Axes, rows: DataFrame, quantity: str, floor: float) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    drawn = rows[(rows[quantity] >= floor) & (rows[quantity] > 0.0) & (rows.wall_min_s > 0.0)]
    for (name, kind), group in drawn.groupby(["method", "kind"], sort=False):
        colour, marker = MARKERS[name]
        fixed = kind == FIXED
        axes.plot(1e3 * group.wall_min_s, group[quantity], color=colour, marker=marker,
                  markersize=6.5, linestyle="-" if fixed else "--", linewidth=1.5,
                  markerfacecolor=colour if fixed else "white", markeredgecolor=colour,
                  zorder=3)  # fmt: skip
    errors: Any = drawn[quantity]
    high = 10.0 ** math.ceil(math.log10(errors.max() if len(errors) else 1.0) + 0.01)
    low = 10.0 ** math.floor(math.log10(errors.min() if len(errors) else high * 1e-3) - 0.7)
    top = high * (high / low) ** 0.1
    failed = rows[rows.failure != ""]
    if len(failed):
        _failures(axes, failed, high, top)
    if floor > low:
        axes.axhspan(low, floor, color="#999999", alpha=0.25, linewidth=0)
        axes.text(0.02, math.sqrt(low * floor), "100 × the reference's own error: none plotted",
                  transform=axes.get_yaxis_transform(), fontsize=7.5, va="center")  # fmt: skip
    axes.set_ylim(low, top)
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _failures(axes: Axes, failed: DataFrame, high: float, top: float) -> None:
    """Show failures in a band above everything, at their wall time."""
    axes.axhspan(high, top, color="#f4e3d7", linewidth=0)
    middle = math.sqrt(high * top)
    axes.text(0.99, middle, f"failed: {len(failed)}", transform=axes.get_yaxis_transform(),
              ha="right", va="center", fontsize=8.5)  # fmt: skip
    for name, wall in zip(failed.method, 1e3 * failed.wall_min_s, strict=True):
        colour, marker = MARKERS[name]
        x = wall if wall > 0.0 else np.nan
        axes.plot(x, middle, marker, color=colour, markerfacecolor="none", markersize=6.5, zorder=3)
        axes.plot(x, middle, "x", color=INK, markersize=5, zorder=4)


def _legend(rows: DataFrame, targets: Collection[float]) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colour, marker=marker, label=name, linewidth=1.5)
        for name, (colour, marker) in MARKERS.items() if name in set(rows.method)
    ]  # fmt: skip
    handles.append(Line2D([], [], color=INK, marker="o", label="fixed steps (full)"))
    handles.append(Line2D([], [], color=INK, marker="o", markerfacecolor="white", linestyle="--",
                          label="tolerance (hollow)"))  # fmt: skip
    if (rows.failure != "").any():
        handles.append(Line2D([], [], color=INK, marker="x", linestyle="none", label="failed"))
    if targets:
        name = f"fastest for {', '.join(f'{target:.0e}' for target in targets)} rad"
        handles.append(Line2D([], [], color=INK, marker="o", linestyle=":", markersize=11,
                              markerfacecolor="none", label=name))  # fmt: skip
    return handles


@styled
def draw_regions(
    x: Array,
    y: Array,
    growth: Mapping[str, Array],
    points: Mapping[str, NDArray[np.complex128]],
    footnote: str,
) -> Figure:
    """Draw regions of absolute stability with the eigenvalues of scenes times their steps in them.

    Args:
        x: real part of z = h lambda, shape (n,).
        y: imaginary part, shape (m,).
        growth: modulus of the stability function by method, shape (m, n).
        points: eigenvalues times steps by scene.
        footnote: small print.

    """
    figure = free_figure(13.0, 8.6)
    grid = figure.add_gridspec(2, 2, left=0.05, right=0.63, top=0.95, bottom=0.1, hspace=0.14,
                               wspace=0.08)  # fmt: skip
    panels: Any = grid.subplots(sharex=True, sharey=True)
    near = figure.add_axes((0.69, 0.53, 0.3, 0.42))
    for axes, (method, modulus) in zip(panels.flat, growth.items(), strict=True):
        colour = MARKERS[method][0]
        axes.contourf(x, y, modulus, levels=[0.0, 1.0], colors=[colour], alpha=0.25)
        axes.contour(x, y, modulus, levels=[1.0], colors=[colour], linewidths=1.8)
        axes.set_title(f"{method}: stable where coloured")
    inside = {name: (z.real >= x[0]) & (z.real <= x[-1]) & (np.abs(z.imag) <= y[-1])
              for name, z in points.items()}  # fmt: skip
    shown = [z[inside[name]] for name, z in points.items()]
    colours = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, INK)
    looks: list[dict[str, Any]] = [
        {"marker": "osD^v<>phX*P"[k % 12], "color": colours[(k + k // 12) % 6],
         "linestyle": "none", "markersize": 6, "markerfacecolor": "none"}
        for k in range(len(points))
    ]  # fmt: skip
    for axes in (*panels.flat, near):
        for z, look in zip(shown, looks, strict=True):
            axes.plot(z.real, z.imag, **look)
        axes.axhline(0.0, color=INK, linewidth=0.6)
        axes.axvline(0.0, color=INK, linewidth=0.6)
    reach = 1.1 * max((float(np.abs(z).max()) for z in shown if len(z)), default=1.0)
    near.set_xlim(-reach, reach)
    near.set_ylim(-reach, reach)
    near.set_title("Near the origin")
    near.set_xlabel("Re hλ")
    for axes in panels[1]:
        axes.set_xlabel("Re hλ")
    for axes in panels[:, 0]:
        axes.set_ylabel("Im hλ")
    handles = [
        Line2D(
            [], [], **look, label=name if inside[name].all() else f"{name} (some beyond the axes)"
        )
        for name, look in zip(points, looks, strict=True)
    ]
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.68, 0.46), fontsize=8.5,
                  frameon=False, ncol=2, title="hλ of the scenes at their start, step h as advised",
                  title_fontsize=9)  # fmt: skip
    note(figure, footnote, 170)
    return figure
