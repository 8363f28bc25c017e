# SPDX-License-Identifier: Apache-2.0
"""One style for all figures: colours, lines, sizes, and how a figure is saved.

A function that draws takes data and returns a `Figure`; `styled` gives it the style.
Angles are drawn in degrees, their rates and errors in radians. Of a long curve
matplotlib leaves out what no picture could show (its setting "path.simplify").
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.state import Array

# colours that the colour-blind can distinguish (Okabe and Ito); line styles differ too
BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
GREY = "#666666"
PURPLE = "#CC79A7"
ORANGE = "#E69F00"
INK = "#222222"

MARKERS = {
    "rk4": (BLUE, "o"),
    "dopri5": (VERMILION, "s"),
    "dop853": (GREEN, "^"),
    "rodas5p": (PURPLE, "D"),
}
"""Colour and marker of each method of integration."""

# arguments of matplotlib that say how something looks
Looks: TypeAlias = "dict[str, Any]"

LINES: tuple[Looks, ...] = (
    {"color": BLUE, "linestyle": "-", "linewidth": 2.6},
    {"color": VERMILION, "linestyle": "--", "linewidth": 1.8},
    {"color": GREEN, "linestyle": ":", "linewidth": 1.8},
    {"color": PURPLE, "linestyle": "-.", "linewidth": 1.5},
    {"color": ORANGE, "linestyle": (0, (5, 1)), "linewidth": 1.2},
    {"color": "#000000", "linestyle": "-", "linewidth": 0.8},
)
"""Looks of curves that may coincide.

Each is thinner than the one below it, so that all can be seen.
"""

DEGREES = float(np.degrees(1.0))

SMALLEST_SHOWN = 1e-17
"""Lower end of logarithmic axes of errors; zero lies below it and is not drawn."""

NO_GAPS: Array = np.empty((0, 2))  # begin and end of each [s]

_FILE = Path(__file__).with_suffix(".mplstyle")
STYLE: Any = mpl.rc_params_from_file(_FILE, use_default_template=False)
# gives a function that makes a figure the style, as a decorator
styled = mpl.rc_context(STYLE)


@styled
def encode(figure: Figure, form: str) -> bytes:
    """Return the file of a figure in a format, such as svg."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=form)
    return drawn.getvalue()


def save_figure(figure: Figure, *paths: Path) -> None:
    """Write a figure into files, whose suffixes name the formats.

    Raises OSError if it cannot.
    """
    for path in paths:
        # Not straight into the file: on a full disk the PDF backend fails without an
        # OSError.
        path.write_bytes(encode(figure, path.suffix.removeprefix(".")))


def leg_names(letter: str) -> list[str]:
    """Name a quantity of each leg, as in γ₁, γ₂, γ₃."""
    return [f"{letter}{subscript}" for subscript in "₁₂₃"]


def stack(labels: Sequence[str], height: float = 2.2) -> tuple[Figure, list[Axes]]:
    """Make panels one above the other with a common time axis.

    The axis shows the run and no more.
    """
    figure = Figure(figsize=(7.0, 1.0 + height * len(labels)))
    grid = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    for axes, label in zip(grid, labels, strict=True):
        axes.set_ylabel(label)
        axes.margins(x=0.0)
    grid[-1].set_xlabel("time t [s]")
    return figure, list(grid)


def break_lines(seconds: Array, values: Array, gaps: Array) -> tuple[Array, Array]:
    """Return times [s] and values with a row of nan in each gap.

    No line is drawn in a gap. Values have the shape (n,) or (n, k), gaps begin and end
    [s], (g, 2).
    """
    places = np.searchsorted(seconds, gaps[:, 0], side="right")
    broken = np.insert(values, places, np.nan, axis=0)
    return np.insert(seconds, places, gaps[:, 0]), broken


def widen(axes: Axes, values: Array, least_span: float) -> None:
    """Show no less than `least_span` of the values, so that rounding is a flat line."""
    limits = values[np.isfinite(values)]
    if len(limits) and np.ptp(limits) < least_span:
        middle = 0.5 * float(limits.min() + limits.max())
        axes.set_ylim(middle - 0.5 * least_span, middle + 0.5 * least_span)


def lines(
    axes: Axes,
    seconds: Array,
    values: Array,
    names: Sequence[str],
    *,
    gaps: Array = NO_GAPS,
    least_span: float = 0.0,
) -> None:
    """Draw columns over time, broken at gaps, the legend above the panel.

    The panel is as `widen` makes it.
    """
    seconds, values = break_lines(seconds, values, gaps)
    for column, name, style in zip(values.T, names, LINES, strict=False):
        axes.plot(seconds, column, label=name, **style)
    widen(axes, values, least_span)
    if len(names) > 1:
        legend(axes)


class Panel(NamedTuple):
    """Curves over time."""

    label: str  # of the axis
    names: Sequence[str]  # of the curves
    values: Array  # shape (n, k)
    seconds: Array | None = None  # shape (n,); None for those of the figure


@styled
def draw_panels(
    seconds: Array,
    panels: Sequence[Panel],
    height: float = 2.2,
    least_span: float = 0.0,
    gaps: Array = NO_GAPS,
) -> Figure:
    """Draw panels over time [s], whose lines are broken at gaps; see `lines`."""
    figure, grid = stack([panel.label for panel in panels], height)
    for axes, panel in zip(grid, panels, strict=True):
        times = seconds if panel.seconds is None else panel.seconds
        looks: Looks = {"gaps": gaps, "least_span": least_span}
        lines(axes, times, panel.values, panel.names, **looks)
    return figure


def legend(axes: Axes, **options: Any) -> None:
    """Put the legend above the panel, where no curve can be."""
    defaults: Looks = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "borderaxespad": 0.1,
        "ncol": 4,
        "fontsize": 8,
        "frameon": False,
    }
    axes.legend(**{**defaults, **options})


def mark_ends(axes: Axes, *path: Array) -> None:
    """Mark the first and the last finite point of a path, shape (n,) a coordinate."""
    finite = np.flatnonzero(np.isfinite(path[0]))
    start = (finite[:1], "o", GREEN, "start")
    end = (finite[-1:], "s", VERMILION, "end")
    for rows, marker, colour, name in (start, end):
        place = [coordinate[rows] for coordinate in path]
        axes.plot(
            *place, marker, color=colour, markersize=6, label=name, linestyle="none"
        )


def note(figure: Figure, text: str, width: int) -> None:
    """Write a note of `width` letters a line at the foot of a figure."""
    lines = [
        sentence
        for line in text.splitlines()
        for sentence in textwrap.wrap(line, width)
    ]
    figure.supxlabel("\n".join(lines), x=0.01, ha="left", fontsize=6.5, color="#555555")


def hide_zeros(values: Array) -> Array:
    """Return values for a logarithmic axis: nan for what lies below SMALLEST_SHOWN."""
    return np.asarray(np.where(values > SMALLEST_SHOWN, values, np.nan))
