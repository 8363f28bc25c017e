# SPDX-License-Identifier: Apache-2.0
"""Work-precision diagram of the engines, from peers.csv: python -m benchmark.peers.picture.

The best settings of each engine are one strong curve, all its methods are thin ones.
"""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from benchmark.measure import DOCS
from benchmark.peers.ours import PUBLIC
from sst_ros.plot.style import BLUE, GREEN, INK, ORANGE, PURPLE, VERMILION, save_figure, styled

STYLES = {
    "sst_ros": (BLUE, "o"),
    "MuJoCo": (VERMILION, "s"),
    "Pinocchio": (GREEN, "D"),
    "Drake": (PURPLE, "^"),
    "Exudyn": (ORANGE, "v"),
    "SciPy on the paper's form": (INK, "P"),
}
"""Colour and marker of each engine, in the order of the legend."""

SMALLEST, LARGEST = 2e-14, 1.0


def draw(folder: Path) -> None:
    """Write peers.png beside peers.csv and peers.json."""
    rows = pd.read_csv(folder / "peers.csv")
    rows = rows[rows.median_ms.notna() & rows.failed.isna()]
    machine = json.loads((folder / "peers.json").read_text(encoding="utf-8"))["machine"]
    note = f"Thin: single methods. {machine['processor']}, one core, {machine['date']}."
    save_figure(draw_engines(rows, note), folder / "peers.png")


@styled
def draw_engines(rows: pd.DataFrame, note: str) -> Figure:
    """Draw one thin curve a method, and the best of all; of sst_ros that of the public call."""
    figure = Figure(figsize=(10.5, 5.4), layout="constrained")
    axes = figure.subplots()
    for engine, own in rows.groupby("engine"):
        colour, marker = STYLES[str(engine)]
        for _, group in own.groupby("method"):
            axes.plot(*find_front(group), color=colour, linewidth=1.0, alpha=0.3)
    for engine, (colour, marker) in STYLES.items():
        own = rows[rows.engine == engine]
        public = own[own.method.str.startswith(PUBLIC)]
        best = find_front(own if public.empty else public)
        axes.plot(
            *best, color=colour, marker=marker, markersize=5, label=engine if len(own) else ""
        )
    for error in (1e-6, 1e-9):  # which the tables name
        axes.axhline(error, color="#666666", linewidth=0.8, linestyle=(0, (6, 4)), zorder=1)
    axes.set(xscale="log", yscale="log", ylim=(0.5 * SMALLEST, LARGEST))
    axes.set_xlabel("processor time of one simulated second [ms], median")
    axes.set_ylabel("error of the orientation at t = 1 s [rad]")
    axes.set_title("Work-precision diagram: Example 2 of the paper", loc="left")
    figure.legend(loc="outside right upper", fontsize=9.5, title="best of all settings")
    figure.supxlabel(note, fontsize=8.5, color="#444444")
    return figure


def find_front(rows: pd.DataFrame) -> tuple[list[float], list[float]]:
    """Times [ms] and errors [rad] that no faster one is as accurate as, in order of time."""
    sorted_rows = rows.sort_values(["median_ms", "error_at_end_rad"])
    best = sorted_rows[sorted_rows.error_at_end_rad.cummin().diff().fillna(-1.0) < 0.0]
    return best.median_ms.tolist(), best.error_at_end_rad.clip(lower=SMALLEST).tolist()


if __name__ == "__main__":
    draw(DOCS)
