# SPDX-License-Identifier: Apache-2.0
"""Panels over one axis of time, in the style of all our pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.paper_figures import LINES

SUBSCRIPTS = "₁₂₃"


def three(letter: str) -> tuple[str, str, str]:
    """Name a quantity of each leg, as in γ₁, γ₂, γ₃."""
    first, second, third = (f"{letter}{subscript}" for subscript in SUBSCRIPTS)
    return first, second, third


def stack(labels: Sequence[str], height: float = 2.2) -> tuple[Figure, list[Axes]]:
    """Make panels one above the other with a common time axis."""
    figure = Figure(figsize=(7.0, 1.0 + height * len(labels)))
    grid = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, label in zip(grid, labels, strict=True):
        axes.set_ylabel(label)
    grid[-1].set_xlabel("time t [s]")
    return figure, list(grid)


def lines(
    axes: Axes,
    seconds: Array,
    values: Array,
    names: Sequence[str],
    styles: Sequence[dict[str, Any]] = LINES,
) -> None:
    """Draw columns over time with a legend above the panel."""
    for column, name, style in zip(values.T, names, styles, strict=False):
        axes.plot(seconds, column, label=name, **style)
    legend(axes)


def legend(axes: Axes) -> None:
    """Put the legend above the panel, where no curve can be."""
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=4, borderaxespad=0.1, fontsize=8,
        frameon=False,
    )  # fmt: skip


def span(panels: Sequence[Axes], seconds: Array) -> None:
    """Show the whole run and no more."""
    for axes in panels:
        axes.set_xlim(float(np.min(seconds)), float(np.max(seconds)))
