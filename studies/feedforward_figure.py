# SPDX-License-Identifier: Apache-2.0
"""Figure of the study of feedforward: errors of all loops, order of the hold, bandwidth limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sst_ros.control.law import MODES
from sst_ros.plot.style import BLUE, GREEN, GREY, INK, ORANGE, VERMILION, free_figure, note, styled
from sst_ros.report.results import provenance
from studies.sampled_data import ORDERS

if TYPE_CHECKING:
    from pandas import DataFrame

    from studies.feedforward import FeedforwardStudy

_LOOKS = ((GREY, "D"), (BLUE, "o"), (GREEN, "^"), (VERMILION, "s"), (ORANGE, "v"))
MARKERS = dict(zip(MODES, _LOOKS, strict=True))
"""Colour and marker of each mode."""

_FAILED, _SPREAD = 12.0, 0.13


@styled
def draw_study(study: FeedforwardStudy, title: str) -> Figure:
    """Draw a study: a panel of errors for each bandwidth, orders of the hold, and limits."""
    loops, bandwidths = study.loops, study.plan.bandwidths
    figure = free_figure(12.5, 10.6)
    upper = figure.add_gridspec(1, len(bandwidths), left=0.13, right=0.985, top=0.895,
                                bottom=0.475, wspace=0.05)  # fmt: skip
    lower = figure.add_gridspec(1, 2, left=0.08, right=0.985, top=0.38, bottom=0.09, wspace=0.2)
    first: Axes | None = None
    for column, bandwidth in enumerate(bandwidths):
        axes = figure.add_subplot(upper[0, column], sharey=first, sharex=first)
        _errors(axes, loops, bandwidth, labelled=first is None)
        first = first or axes
    _holds(figure.add_subplot(lower[0, 0]), study)
    _limits(figure.add_subplot(lower[0, 1]), study.limits)
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle="none", label=mode)
        for mode, (colour, marker) in MARKERS.items()
    ]
    label = f"failed: {len(study.failed)}, see below"
    failed = Line2D([], [], color=INK, marker="x", linestyle="none", label=label)
    figure.legend(handles=[*handles, failed], loc="center", bbox_to_anchor=(0.5, 0.945),
                  ncol=7, fontsize=9, frameon=False)  # fmt: skip
    figure.suptitle(title, fontsize=12, y=0.985)
    note(figure, "\n".join([*_reasons(study.failed.failure), provenance()]), 200)
    return figure


def _reasons(failures: Iterable[str]) -> Iterator[str]:
    """Yield the most frequent reasons of failures in a line, if there are any."""
    reasons = Counter(
        text.partition(": ")[2 if "stopped at" in text else 0] for text in failures
    ).most_common(4)
    if reasons:
        listed = "; ".join(f"{count} × {reason}" for reason, count in reasons)
        yield f"Failed: {listed}. The table and the CSV have the reason of each."


def _errors(axes: Axes, loops: DataFrame, bandwidth: float, *, labelled: bool) -> None:
    names = list(loops.error.unique())
    low, high = 0.5 * loops.rms_rad.min(), 2.0 * loops.rms_rad.max()
    axes.set_xscale("log")
    own = loops.bandwidth_rad_per_s
    for loop in loops[(own == bandwidth) | own.isna()].itertuples():
        colour, marker = MARKERS[loop.mode]
        place = list(MARKERS).index(loop.mode)
        y = names.index(loop.error) + (place - 2) * _SPREAD
        if loop.failure:
            x = high * _FAILED ** ((place + 0.5) / len(MARKERS))
            axes.plot(x, y, marker, color=colour, markerfacecolor="white", markersize=5.5, zorder=3)
            axes.plot(x, y, "x", color=INK, markersize=4, zorder=4)
        else:
            axes.plot(loop.rms_rad, y, marker, color=colour, markersize=5.5, zorder=3)
    for row in range(len(names)):
        axes.axhline(row + 0.5, color="#cccccc", linewidth=0.6)
    axes.axvspan(high, high * _FAILED, color="#f4e3d7", linewidth=0)
    axes.set(xlim=(low, high * _FAILED), ylim=(len(names) - 0.5, -0.5))
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelleft=labelled, length=0)
    axes.grid(axis="y", visible=False)
    axes.set(title=f"feedback at {bandwidth:g} rad/s", xlabel="RMS error of γ [rad]")


def _holds(axes: Axes, study: FeedforwardStudy) -> None:
    """Error over period, each with the line of its theory through the shortest period."""
    holds, unheld, orders = study.holds, study.unheld[0], study.orders()
    for (at, group), colour, marker in zip(
        holds.groupby("at", sort=False), (BLUE, VERMILION), ("o", "s"), strict=False
    ):
        x, y = 1e3 * group.period_s.to_numpy(), group.error.to_numpy()
        order, theory = orders[at], ORDERS[at]
        axes.plot(x, y[0] * (x / x[0]) ** theory, color=colour, linewidth=1.0)
        axes.plot(x, y, marker, color=colour, markersize=7,
                  label=f"torque at the {at} of the hold: order {order:.3f} "
                        f"(line: {theory})")  # fmt: skip
    axes.axhline(unheld, color=GREEN, linewidth=2.0, label=f"nothing held: {unheld:.0e} rad")
    periods = 1e3 * np.unique(holds.period_s.to_numpy())
    axes.set_xscale("log", base=2)
    axes.set(yscale="log", ylim=(0.2 * unheld, 10.0 * holds.error.max()))
    axes.set_xticks(periods, [f"{period:g}" for period in periods])
    axes.set(xlabel="control period [ms]", ylabel="largest error of γ [rad]")
    axes.set_title("Exact model, feedforward alone")
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.33), fontsize=8.5)


def _limits(axes: Axes, limits: DataFrame) -> None:
    """Largest stable bandwidth over delay: theory as a line, simulations as markers."""
    axes.set_title("computed_torque, exact model: stable below")
    axes.set(xlabel="delay of the command [samples]", ylabel="largest stable bandwidth [rad/s]")
    if limits.empty:
        return
    axes.fill_between(limits.delay, 1.0, limits.theory, color=GREEN, alpha=0.12, linewidth=0.0)
    axes.plot(limits.delay, limits.theory, color=GREEN,
              label="poles of the sampled double integrator")  # fmt: skip
    axes.plot(limits.delay, limits.ideal, "^", color=GREEN, markersize=8,
              label="simulated, without friction and lag")  # fmt: skip
    axes.plot(limits.delay, limits.real, "o", color=BLUE, markersize=8, markerfacecolor="none",
              label="simulated, the plant as it is")  # fmt: skip
    axes.set(yscale="log", ylim=(0.5 * limits.theory.min(), 2.0 * limits.theory.max()))
    axes.set_xticks(limits.delay)
    axes.legend(loc="upper right", fontsize=8.5)
