# SPDX-License-Identifier: Apache-2.0
"""Pictures of the motion: angles, rates, phase portraits, distance to the limits."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sst_ros.mechanism.geometry import Geometry
from sst_ros.plot.panels import lines, span, stack, three
from sst_ros.plot.paper_figures import BLUE, GREEN, LINES, VERMILION
from sst_ros.recording.signals import Signals
from sst_ros.scene.scene import Scene

KINDS = {"gamma": "γ", "mu": "μ", "beta": "β"}


def joint_angles(run: Signals, _: Scene | None) -> Figure:
    """Draw the angles of all nine joints."""
    return _of_kinds(run, "{}", "{} [deg]", "{}", np.degrees(1.0))


def joint_rates(run: Signals, _: Scene | None) -> Figure:
    """Draw the rates of all nine joints, of the actuators and the passive ones."""
    return _of_kinds(run, "{}_dot", "{}̇ [rad/s]", "{}̇", 1.0)


def _of_kinds(run: Signals, quantity: str, label: str, name: str, scale: float) -> Figure:
    figure, panels = stack([label.format(letter) for letter in KINDS.values()])
    for axes, (kind, letter) in zip(panels, KINDS.items(), strict=True):
        values = scale * run.legs(quantity.format(kind))
        lines(axes, run.seconds(), values, three(name.format(letter)))
    span(panels, run.seconds())
    return figure


def phase(run: Signals, _: Scene | None) -> Figure:
    """Draw each actuator's rate over its angle, from the circle to the square."""
    figure = Figure(figsize=(10.5, 3.8))
    angle, rate = np.degrees(run.legs("gamma")), run.legs("gamma_dot")
    for leg, axes in enumerate(figure.subplots(1, 3)):
        known = np.isfinite(angle[:, leg])
        x, y = angle[known, leg], rate[known, leg]
        axes.plot(angle[:, leg], rate[:, leg], color=BLUE, linewidth=1.4)
        axes.plot(x[:1], y[:1], "o", color=GREEN, markersize=7, label="start")
        axes.plot(x[-1:], y[-1:], "s", color=VERMILION, markersize=6, label="end")
        axes.set_xlabel(f"{three('γ')[leg]} [deg]")
        axes.set_ylabel(f"{three('γ̇')[leg]} [rad/s]")
    figure.axes[-1].legend(loc="best", fontsize=8)
    return figure


def margins(run: Signals, scene: Scene) -> Figure:
    """Draw the distance of each leg to the nearest limit of its joints."""
    geometry = Geometry.of(scene)
    gamma, beta = run.legs("gamma"), run.legs("beta")
    stroke = np.degrees(np.minimum(gamma, geometry.arc - gamma))
    reach = np.degrees(np.minimum(beta, geometry.beta_max - beta))
    figure, panels = stack(["to an end of the stroke [deg]", "to a limit of β [deg]"], 2.6)
    for axes, values in zip(panels, (stroke, reach), strict=True):
        lines(axes, run.seconds(), values, [f"leg {leg}" for leg in (1, 2, 3)], LINES)
        axes.axhline(0.0, color="black", linewidth=0.8)
    span(panels, run.seconds())
    return figure
