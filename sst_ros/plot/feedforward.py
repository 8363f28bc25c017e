# SPDX-License-Identifier: Apache-2.0
"""The picture of a study of feedforward: errors of all loops, order of the hold, limits."""

from __future__ import annotations

import textwrap
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sst_ros.control.controller_settings import INSTANTS, MODES
from sst_ros.plot.paper_figures import BLUE, GREEN, GREY, STYLE, VERMILION
from sst_ros.studies.feedforward import OPEN_LOOP, Study
from sst_ros.studies.feedforward_table import failed, made, of_instant, order, title
from sst_ros.studies.sampled_data import ORDERS

ORANGE = "#E69F00"
LOOKS = dict(
    zip(
        MODES,
        ((GREY, "D"), (BLUE, "o"), (GREEN, "^"), (VERMILION, "s"), (ORANGE, "v")),
        strict=True,
    )
)
"""Colour and marker of each mode."""

_FAILED, _SPREAD, _REASONS = 12.0, 0.13, 4


def draw(study: Study, path: Path) -> None:
    """Write the picture as PNG."""
    with mpl.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        figure = Figure(figsize=(12.5, 10.6))
        count = len(study.plan.bandwidths)
        upper = figure.add_gridspec(1, count, left=0.13, right=0.985, top=0.895, bottom=0.475,
                                    wspace=0.05)  # fmt: skip
        lower = figure.add_gridspec(1, 2, left=0.08, right=0.985, top=0.38, bottom=0.09,
                                    wspace=0.2)  # fmt: skip
        first: Axes | None = None
        for column, bandwidth in enumerate(study.plan.bandwidths):
            axes = figure.add_subplot(upper[0, column], sharey=first, sharex=first)
            _errors(axes, study, bandwidth, labelled=first is None)
            first = first or axes
        _holds(figure.add_subplot(lower[0, 0]), study)
        _limits(figure.add_subplot(lower[0, 1]), study)
        figure.legend(handles=_legend(study), loc="center", bbox_to_anchor=(0.5, 0.945), ncol=7,
                      fontsize=9, frameon=False)  # fmt: skip
        figure.suptitle(title(study), fontsize=12, y=0.985)
        figure.text(0.01, 0.01, _note(study), fontsize=6.8, color="#555555", va="bottom")
        figure.savefig(path)


def _errors(axes: Axes, study: Study, bandwidth: float, *, labelled: bool) -> None:
    names = list(dict.fromkeys(outcome.error for outcome in study.outcomes))
    reached = [outcome.rms for outcome in study.outcomes if outcome.rms]
    low, high = 0.5 * min(reached, default=1e-6), 2.0 * max(reached, default=1e-1)
    axes.set_xscale("log")
    for row, name in enumerate(names):
        for place, (mode, (colour, marker)) in enumerate(LOOKS.items()):
            outcome = study.of(name, mode, None if mode == OPEN_LOOP else bandwidth)
            y = row + (place - 2) * _SPREAD
            x = outcome.rms if outcome.rms else high * _FAILED ** ((place + 0.5) / len(LOOKS))
            face = colour if outcome.rms else "white"
            axes.plot(x, y, marker, color=colour, markerfacecolor=face, markersize=5.5, zorder=3)
            if not outcome.rms:
                axes.plot(x, y, "x", color="#222222", markersize=4, zorder=4)
        axes.axhline(row + 0.5, color="#cccccc", linewidth=0.6)
    axes.axvspan(high, high * _FAILED, color="#f4e3d7", linewidth=0)
    axes.set_xlim(low, high * _FAILED)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelleft=labelled, length=0)
    axes.grid(axis="y", visible=False)
    axes.set_title(f"feedback at {bandwidth:g} rad/s", loc="left")
    axes.set_xlabel("RMS error of γ [rad]")


def _holds(axes: Axes, study: Study) -> None:
    """Error over period, each with the line of its theory through the shortest period."""
    for at, colour, marker in zip(INSTANTS, (BLUE, VERMILION), ("o", "s"), strict=True):
        found = of_instant(study, at)
        x = np.array([1e3 * hold.period_s for hold in found])
        y = np.array([hold.error for hold in found])
        axes.plot(x, y[0] * (x / x[0]) ** ORDERS[at], color=colour, linewidth=1.0)
        axes.plot(x, y, marker, color=colour, markersize=7,
                  label=f"torque of the {at} of the hold: order {order(found):.3f} "
                        f"(line: {ORDERS[at]})")  # fmt: skip
    axes.axhline(study.exact.error, color=GREEN, linewidth=2.0,
                 label=f"nothing held: {study.exact.error:.0e} rad")  # fmt: skip
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xticks(x, [f"{period:g}" for period in x])
    axes.set_ylim(0.2 * study.exact.error, 10.0 * max(h.error for h in study.holds))
    axes.set_xlabel("control period [ms]")
    axes.set_ylabel("largest error of γ [rad]")
    axes.set_title("Right model, feedforward alone", loc="left")
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.33), fontsize=8.5)


def _limits(axes: Axes, study: Study) -> None:
    """Largest stable bandwidth over delay: theory as a line, simulations as markers."""
    delays = [ideal.delay for ideal, _ in study.limits]
    theory = [ideal.theory for ideal, _ in study.limits]
    axes.fill_between(delays, 1.0, theory, color=GREEN, alpha=0.12, linewidth=0.0)
    axes.plot(delays, theory, color=GREEN, label="poles of the sampled double integrator")
    axes.plot(delays, [ideal.simulated for ideal, _ in study.limits], "^", color=GREEN,
              markersize=8, label="simulated, without friction and lag")  # fmt: skip
    axes.plot(delays, [real.simulated for _, real in study.limits], "o", color=BLUE, markersize=8,
              markerfacecolor="none", label="simulated, the plant as it is")  # fmt: skip
    axes.set_yscale("log")
    axes.set_ylim(0.5 * min(theory), 2.0 * max(theory))
    axes.set_xticks(delays)
    axes.set_xlabel("delay of the command [samples]")
    axes.set_ylabel("largest stable bandwidth [rad/s]")
    axes.set_title("computed_torque, right model: stable below", loc="left")
    axes.legend(loc="upper right", fontsize=8.5)


def _legend(study: Study) -> list[Line2D]:
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle="none", label=mode)
        for mode, (colour, marker) in LOOKS.items()
    ]
    if failed(study):
        handles.append(Line2D([], [], color="#222222", marker="x", linestyle="none",
                              label=f"failed: {len(failed(study))}, see below"))  # fmt: skip
    return handles


def _note(study: Study) -> str:
    """Reasons of failures, alike ones once, and how the study was made."""
    reasons: dict[str, int] = {}
    for outcome in failed(study):
        first, _, last = outcome.failure.partition(": ")
        told = last if "stopped at" in first else first
        reasons[told] = reasons.get(told, 0) + 1
    lines = [made(study)]
    if reasons:
        listed = "; ".join(f"{count} × {kind}" for kind, count in list(reasons.items())[:_REASONS])
        lines.insert(0, f"Failed: {listed}. Each has its reason in the table and in the CSV.")
    return "\n".join(part for line in lines for part in textwrap.wrap(line, 200))
