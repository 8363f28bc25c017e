# SPDX-License-Identifier: Apache-2.0
"""Work-precision diagram of the engines, from peers.csv: python -m benchmark.peers.picture.

The best settings of each engine are one strong curve, all its methods are thin ones. Colours are
those of Okabe and Ito.
"""

from __future__ import annotations

import csv
import json
from itertools import groupby
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.peers.ours import PUBLIC

STYLES = {
    "sst_ros": ("#0072B2", "o"),
    "MuJoCo": ("#D55E00", "s"),
    "Pinocchio": ("#009E73", "D"),
    "Drake": ("#CC79A7", "^"),
    "Exudyn": ("#E69F00", "v"),
    "SciPy on the paper's form": ("#000000", "P"),
}
"""Colour and marker of each engine, in the order of the legend."""

SMALLEST, LARGEST = 2e-14, 1.0
LINES = (1e-6, 1e-9)
"""Errors that the tables name [rad]."""
STYLE: Any = {
    "font.size": 11,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
}

Points = list[tuple[float, float]]
"""Processor time [ms] and error [rad]."""


def draw(folder: Path) -> None:
    """Write peers.png beside peers.csv and peers.json."""
    with (folder / "peers.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["median_ms"] and not row["failed"]]
    machine = json.loads((folder / "peers.json").read_text(encoding="utf-8"))["machine"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.4), dpi=150, layout="constrained")
        axes = figure.subplots()
        for engine, (colour, marker) in STYLES.items():
            own = [row for row in rows if row["engine"] == engine]
            if own:
                _engine(axes, engine, own, colour, marker)
        for error in LINES:
            axes.axhline(error, color="#666666", linewidth=0.8, linestyle=(0, (6, 4)), zorder=1)
        axes.set(xscale="log", yscale="log", ylim=(0.5 * SMALLEST, LARGEST))
        axes.set_xlabel("processor time of one simulated second [ms], median")
        axes.set_ylabel("error of the orientation at t = 1 s [rad]")
        axes.set_title("Work-precision diagram: Example 2 of the paper", loc="left")
        figure.legend(loc="outside right upper", fontsize=9.5, title="best of all settings")
        note = f"Thin: single methods. {machine['processor']}, one core, {machine['date']}."
        figure.supxlabel(note, fontsize=8.5, color="#444444")
        figure.savefig(folder / "peers.png")


def _engine(axes: Axes, engine: str, rows: list[dict[str, str]], colour: str, marker: str) -> None:
    """Draw one thin curve a method, and the best of all; of sst_ros that of the public call."""
    found: Points = []
    public = any(row["method"].startswith(PUBLIC) for row in rows)
    for _, group in groupby(rows, key=lambda row: row["method"]):
        of_method = list(group)
        points = front(_points(of_method))
        if not public or of_method[0]["method"].startswith(PUBLIC):
            found += points
        axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.0, alpha=0.3)
    axes.plot(
        *zip(*front(found), strict=True), color=colour, marker=marker, markersize=5, label=engine
    )


def _points(rows: list[dict[str, str]]) -> Points:
    values = [(float(row["median_ms"]), float(row["error_at_end_rad"])) for row in rows]
    return [(time, max(error, SMALLEST)) for time, error in values]


def front(points: Points) -> Points:
    """Points that no faster one is as accurate as, in order of time."""
    best: Points = []
    for time, error in sorted(points):
        if not best or error < best[-1][1]:
            best.append((time, error))
    return best


if __name__ == "__main__":
    draw(Path(__file__).parents[2] / "docs")
