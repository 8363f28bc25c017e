# SPDX-License-Identifier: Apache-2.0
"""Pictures of the control: desired against measured motion, and the torques behind it."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Array
from sst_ros.plot.panels import legend, lines, span, stack, three
from sst_ros.plot.paper_figures import BLUE, GREY, VERMILION, held
from sst_ros.recording.signals import Signals
from sst_ros.scene.scene import Scene


def tracking(run: Signals, _: Scene | None) -> Figure:
    """Draw the desired angle of each actuator, and the measured one over it."""
    figure, panels = stack([f"{name} [deg]" for name in three("γ")])
    desired, measured = (np.degrees(run.legs(name)) for name in ("gamma_desired", "gamma"))
    for leg, axes in enumerate(panels):
        axes.plot(run.seconds(), desired[:, leg], color=GREY, linewidth=3.2, label="desired")
        axes.plot(run.seconds(), measured[:, leg], "--", color=BLUE, linewidth=1.5,
                  label="measured")  # fmt: skip
    legend(panels[0])
    span(panels, run.seconds())
    return figure


def tracking_error(run: Signals, _: Scene | None) -> Figure:
    """Draw desired less measured, as the controller saw it."""
    figure, panels = stack(["γ desired − γ [rad]", "γ̇ desired − γ̇ [rad/s]"], 2.6)
    lines(panels[0], run.seconds(), run.legs("gamma_error"), three("γ"))
    lines(panels[1], run.seconds(), run.legs("gamma_dot_error"), three("γ̇"))
    span(panels, run.seconds())
    return figure


def control_torques(run: Signals, _: Scene | None) -> Figure:
    """Draw what the model of the controller asks for, and what its feedback adds."""
    labels = ["feedforward [N m]", "feedback [N m]"]
    figure, panels = stack(labels, 2.6)
    for axes, name in zip(panels, ("tau_feedforward", "tau_feedback"), strict=True):
        lines(axes, run.seconds(), run.legs(name), three("τ"))
    span(panels, run.seconds())
    return figure


def applied_and_commanded(run: Signals, _: Scene | None) -> Figure:
    """Draw the torque of each tick, and the commands over it where they were recorded.

    Commands without a stamp lie where the recorder got them, by its clock.
    """
    figure, panels = stack([f"{name} [N m]" for name in three("τ")])
    times, torque = torques(run)
    at, commands = _commands(run, float(times[0]), float(times[-1]))
    for leg, axes in enumerate(panels):
        axes.plot(times, torque[:, leg], color=BLUE, linewidth=3.0, label="applied")
        if len(at):
            axes.plot(at, commands[:, leg], ".", markersize=1.5, color=VERMILION, label="commanded")
    legend(panels[0])
    span(panels, times)
    return figure


def torques(run: Signals) -> tuple[Array, Array]:
    """Return times [s] and torques [N m], shape (m, 3), that draw what each tick held."""
    start = run.time_ns("ticks")
    length = run.take("length", table="ticks")[:, 0].astype(np.int64)
    return held(start, start + length, run.legs("tau", "ticks"))


def _commands(run: Signals, begin: float, end: float) -> tuple[Array, Array]:
    table = next((name for name in ("commands_stamped", "commands") if name in run.tables), None)
    if table is None:
        return np.empty(0), np.empty((0, 3))
    at, values = run.seconds(table), run.legs("tau", table)
    inside = (at >= begin) & (at <= end)
    return at[inside], values[inside]
