# SPDX-License-Identifier: Apache-2.0
"""A run that tracked a reference, on one page: the motion, the error, the torques behind it."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.paper_figures import GREY, LINES, STYLE
from sst_ros.report.tracking import TrackedRun

LEGS = "₁₂₃"
SMALLEST_SHOWN = 1e-17


def draw(tracked: TrackedRun, title: str, out: Path) -> Path:
    """Write the page as one PNG file and return its path."""
    track = tracked.track
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 7.4))
        (motion, error), (growth, torque) = figure.subplots(2, 2, sharex=True)
        _motion(motion, track.time, track.gamma, track.gamma - track.error)
        error.set_title("Tracking error", loc="left")
        error.set_ylabel("γ desired − γ [rad]")
        _legs(error, track.time, track.error, "γ")
        _growth(growth, tracked)
        torque.set_title("Torques: feedforward, and feedback (thin)", loc="left")
        torque.set_ylabel("torque [N m]")
        _legs(torque, track.time, track.feedforward, "τ")
        for values, line in zip(track.feedback.T, LINES, strict=True):
            torque.plot(track.time, values, color=line["color"], linewidth=0.8)
        for axes in (motion, error, growth, torque):
            axes.set_xlim(track.time[0], track.time[-1])
        for axes in (growth, torque):
            axes.set_xlabel("time of the run t [s]")
        figure.suptitle(title, fontsize=12)
        figure.savefig(out)
    return out


def _motion(axes: Axes, time: Array, desired: Array, measured: Array) -> None:
    axes.set_title("The motion: measured, over the desired one (grey)", loc="left")
    axes.set_ylabel("γ [deg]")
    for values in np.degrees(desired).T:
        axes.plot(time, values, color=GREY, linewidth=5.0, alpha=0.4)
    _legs(axes, time, np.degrees(measured), "γ")


def _growth(axes: Axes, tracked: TrackedRun) -> None:
    """Draw the error against run time, on a logarithmic axis."""
    axes.set_title("Error against run time", loc="left")
    axes.set_ylabel("error [rad]")
    worst = np.abs(tracked.track.error).max(axis=1)
    curves = (
        ("largest of γ", worst),
        ("orientation", tracked.orientation_error),
        ("largest of γ so far", np.maximum.accumulate(worst)),
    )
    for (name, values), line in zip(curves, LINES, strict=True):
        shown = np.where(values > SMALLEST_SHOWN, values, np.nan)
        if np.isfinite(shown).any():
            axes.plot(tracked.track.time, shown, label=name, **line)
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def _legs(axes: Axes, time: Array, values: Array, letter: str) -> None:
    for column, leg, line in zip(values.T, LEGS, LINES, strict=True):
        axes.plot(time, column, label=f"{letter}{leg}", **line)
    axes.legend(fontsize=8, loc="best")
