# SPDX-License-Identifier: Apache-2.0
"""The picture of stability: which steps are stable at which stiffness, method by method."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from sst_ros.plot.paper_figures import STYLE
from sst_ros.plot.work_precision import MARKERS as LOOKS
from sst_ros.studies.stability import LONGEST_S, Stable


def draw(steps: Sequence[Stable], made: str, path: Path) -> None:
    """Write the picture as PNG."""
    with mpl.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(8.6, 6.0))
        axes = figure.subplots()
        figure.subplots_adjust(left=0.1, right=0.97, top=0.9, bottom=0.17)
        axes.set_xscale("log")
        axes.set_yscale("log")
        lowest = min(step.step for step in steps)
        for name, (colour, marker) in LOOKS.items():
            rows = [step for step in steps if step.method == name]
            if not rows:
                continue
            x, y = (np.array(v) for v in zip(*((r.decay, r.step) for r in rows), strict=True))
            everywhere = bool(np.all(y >= LONGEST_S))
            reached = f"every step tried, up to {LONGEST_S:g} s"
            if not everywhere:
                reached = f"step × decay ≤ {y[-1] * x[-1]:.2f}"
            if not everywhere:
                axes.fill_between(x, 0.1 * lowest, y, color=colour, alpha=0.10, linewidth=0.0)
            axes.plot(x, y, color=colour, marker=marker, linewidth=2.0, markersize=7,
                      clip_on=False, zorder=4, label=f"{name}: {reached}")  # fmt: skip
        axes.set_ylim(0.3 * lowest, 2.0 * LONGEST_S)
        axes.set_xlim(min(s.decay for s in steps), max(s.decay for s in steps))
        axes.set_xlabel("fastest decay of the stiff family [1/s]")
        axes.set_ylabel("step [s]; below its line a method is stable")
        axes.set_title("Largest stable step over stiffness", loc="left")
        axes.legend(loc="lower left", fontsize=9)
        figure.text(0.01, 0.015, "\n".join(textwrap.wrap(made, 140)), fontsize=6.5,
                    color="#555555")  # fmt: skip
        figure.savefig(path)
