# SPDX-License-Identifier: Apache-2.0
"""Error against processor time, both logarithmic; colours of Okabe and Ito, a marker a curve."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.peers.results import Results
from benchmark.peers.study import TARGETS, Curve

COLOURS = {
    "sst_ros": "#0072B2",
    "MuJoCo": "#D55E00",
    "Pinocchio": "#009E73",
    "Drake": "#CC79A7",
    "Exudyn": "#E69F00",
    "SciPy on the paper's form": "#000000",
}
LINES: tuple[Any, ...] = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKERS = "osD^vPX<>*hpdH8"
SMALLEST, LARGEST = 2e-14, 1.0
STYLE: Any = {
    "font.size": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def draw(results: Results, path: Path) -> None:
    """Write the PNG."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 6.2), dpi=150, layout="constrained")
        axes = figure.subplots()
        shown: dict[str, int] = {}
        for index, curve in enumerate(c for c in results.curves if c.front):
            line = shown.setdefault(curve.series.engine, 0)
            shown[curve.series.engine] += 1
            _curve(axes, curve, MARKERS[index % len(MARKERS)], LINES[line % len(LINES)])
        for target in TARGETS[1:]:
            axes.axhline(target, color="#666666", linewidth=0.8, linestyle=(0, (6, 4)), zorder=1)
        axes.set(xscale="log", yscale="log", ylim=(0.5 * SMALLEST, LARGEST))
        axes.set_xlabel("processor time of one simulated second [ms], median")
        axes.set_ylabel("error of the star's orientation at t = 1 s [rad]")
        axes.set_title("Example 2 of the paper, the same second on each engine", loc="left")
        figure.legend(loc="outside right upper", fontsize=8.5, handlelength=3.6, frameon=False)
        told = results.machine
        note = f"{told['processor']}, one core, {told['date']}. General engines against a solver"
        note += " for this mechanism only: see peers.md."
        figure.supxlabel(note, fontsize=8, color="#444444")
        figure.savefig(path)


def _curve(axes: Axes, curve: Curve, marker: str, line: Any) -> None:
    points = [p for p in curve.front if p.error >= SMALLEST]
    engine = curve.series.engine
    short = re.sub(" on the paper's form$", ", paper's form", engine)
    colour = COLOURS.get(engine, "#666666")
    axes.plot(
        [1e3 * p.time for p in points],
        [p.error for p in points],
        color=colour,
        linestyle=line,
        linewidth=1.5,
        marker=marker,
        markersize=5.5,
        markerfacecolor=colour if engine == "sst_ros" else "white",
        markeredgecolor=colour,
        label=f"{short}: {curve.series.name}",
    )
