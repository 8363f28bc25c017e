# SPDX-License-Identifier: Apache-2.0
"""Figures of stability: largest stable steps, and regions of absolute stability."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
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
from sst_ros.plot.work_precision import MARKERS

if TYPE_CHECKING:
    from pandas import DataFrame

TITLES = {"decay": "Damped: viscous friction", "oscillation": "Oscillating: springs"}


@styled
def draw_largest_steps(steps: DataFrame, longest: float, footnote: str) -> Figure:
    """Draw the largest stable step over the fastest rate, a panel for each family.

    Args:
        steps: family, method, rate [1/s] and step [s].
        longest: the longest step that was tried [s].
        footnote: small print.

    """
    families = list(steps.family.unique())
    figure = free_figure(6.2 * len(families) + 0.6, 6.0)
    panels = figure.subplots(1, len(families), squeeze=False)[0]
    figure.subplots_adjust(left=0.07, right=0.985, top=0.91, bottom=0.16, wspace=0.18)
    for axes, family in zip(panels, families, strict=True):
        own = steps[steps.family == family]
        axes.set_xscale("log")
        axes.set_yscale("log")
        for name, rows in own.groupby("method", sort=False):
            colour, marker = MARKERS[name]
            x, y = rows.rate.to_numpy(), rows.step.to_numpy()
            reached = f"every step tried, up to {longest:g} s"
            if not (y >= longest).all():
                reached = f"step × rate ≤ {x[-1] * y[-1]:.2f}"
                axes.fill_between(x, 1e-12, y, color=colour, alpha=0.10, linewidth=0.0)
            axes.plot(x, y, color=colour, marker=marker, linewidth=2.0, markersize=7,
                      clip_on=False, zorder=4, label=f"{name}: {reached}")  # fmt: skip
        axes.set_ylim(0.3 * own.step.min(), 2.0 * longest)
        axes.set_xlim(own.rate.min(), own.rate.max())
        axes.set_xlabel("largest |λ| of the family [1/s]")
        axes.set_title(TITLES.get(family, family))
        axes.legend(loc="lower left", fontsize=9)
    panels[0].set_ylabel("step [s]; a method is stable below its line")
    note(figure, footnote, 60 + 80 * len(families))
    return figure


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
