# SPDX-License-Identifier: Apache-2.0
"""The numbers beside the picture: state, joints, health, and curves of gamma and torque."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from html import escape

import numpy as np
from viser import GuiUplotHandle, ViserServer, uplot

from sst_ros.description.shapes import LEG_COLOURS
from sst_ros.scene.scene import Scene
from sst_ros.view.source import Health, Sample

WINDOW_S = 10.0
_POINTS = 500
_COLOURS = tuple("#" + "".join(f"{round(255 * x):02x}" for x in rgb) for rgb in LEG_COLOURS)
_LIGHTS = ("#2b8a3e", "#e67700", "#c92a2a")
_STYLE = (
    "font-size:13px;line-height:1.5;padding:2px 10px;font-variant-numeric:tabular-nums;"
    "overflow-wrap:anywhere;"
)
SHOWN = {
    "error_estimate": ("estimated error", "rad", ".1e"),
    "energy_residual_J": ("energy residual", "J", ".1e"),
    "closure_residual": ("loops open by", "", ".1e"),
    "real_time_factor_now": ("speed", "× real time", ".3f"),
    "step_mean_us": ("mean step", "µs", ".0f"),
    "ticks_missed": ("missed ticks", "", ".0f"),
    "commands_dropped": ("commands dropped", "", ".0f"),
}
"""Which of the diagnostics are shown, as what, in which unit."""


class Panel:
    """All of it, for one scene."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        gui = server.gui
        self._head = gui.add_html(_head(scene, None, Health()), order=0.0)
        self._joints = gui.add_html("", order=2.0)
        with gui.add_folder("angles γ of the actuators, last 10 s", order=3.0) as first:
            self._gamma = _plot(server, "γ [deg]", (0.0, 90.0))
        with gui.add_folder("torques τ, last 10 s", order=4.0) as second:
            self._torque = _plot(server, "τ [N m]", (-1.0, 1.0))
        with gui.add_folder("health of the run", order=6.0) as third:
            self._health = gui.add_html("")
        self._owned = (self._head, self._joints, first, second, third)
        self._scene = scene
        self._rows: deque[tuple[float, ...]] = deque(maxlen=_POINTS)

    def remove(self) -> None:
        """Take it off the page."""
        for handle in self._owned:
            handle.remove()

    def follow(self, sample: Sample) -> None:
        """Note a sample for the curves; a time that goes back begins new ones."""
        if sample.time is None:
            return
        last = self._rows[-1][0] if self._rows else -np.inf
        if sample.time < last:
            self._rows.clear()
            last = -np.inf
        if sample.time - last >= WINDOW_S / _POINTS:
            self._rows.append((sample.time, *np.degrees(sample.gamma), *sample.torque))

    def show(self, sample: Sample, health: Health) -> None:
        """Show numbers of a sample."""
        self._head.content = _head(self._scene, sample, health)
        self._joints.content = _table(sample)
        self._health.content = _healthy(health)

    def draw(self) -> None:
        """Draw the curves."""
        if len(self._rows) < 2:
            return
        rows = np.array(self._rows)
        rows = rows[rows[:, 0] > rows[-1, 0] - WINDOW_S]
        for plot, columns in ((self._gamma, rows[:, 1:4]), (self._torque, rows[:, 4:7])):
            plot.data = (rows[:, 0], *columns.T.copy())


def _plot(server: ViserServer, label: str, least: tuple[float, float]) -> GuiUplotHandle:
    """Make curves of three legs whose axis shows the range `least` at least."""
    empty = np.array([0.0, 1.0])
    lines: list[uplot.Series] = [{"label": "t [s]"}]
    for k, colour in enumerate(_COLOURS):
        lines.append({"label": f"{label[0]}{'₁₂₃'[k]}", "stroke": colour, "width": 2.0})
    ends = {
        end: {"soft": value, "mode": 1, "pad": 0.1}
        for end, value in zip(("min", "max"), least, strict=True)
    }
    return server.gui.add_uplot(
        (empty, *(np.zeros(2) for _ in range(3))),
        tuple(lines),
        scales={"x": {"time": False}, "y": {"range": ends}},
        axes=({"label": "t [s]", "labelSize": 16, "size": 26}, {"label": label, "size": 44}),
        legend={"show": False},
        height=130,
    )


def _head(scene: Scene, sample: Sample | None, health: Health) -> str:
    time = "&ndash;" if sample is None or sample.time is None else f"{sample.time:.2f} s"
    phase = health.phase or "no simulator"
    light = _LIGHTS[2 if phase.startswith("fault") else health.level]
    return (
        f'<div style="{_STYLE}"><div style="font-size:15px"><b>{escape(scene.name)}</b></div>'
        f'<div style="color:#555">{escape(scene.description)}</div>'
        f'<div style="font-size:15px"><b id="sst-phase" style="color:{light}">{escape(phase)}</b>'
        f' &nbsp; t = <span id="sst-time">{time}</span></div></div>'
    )


def _table(sample: Sample) -> str:
    rows = (
        ("γ", "deg", np.degrees(sample.gamma)),
        ("γ̇", "rad/s", sample.gamma_dot),
        ("τ", "N m", sample.torque),
        ("μ", "deg", np.degrees(sample.mu)),
        ("β", "deg", np.degrees(sample.beta)),
    )
    heads = "".join(
        f'<th style="color:{colour};text-align:right;width:24%">leg {k + 1}</th>'
        for k, colour in enumerate(_COLOURS)
    )
    body = "".join(_row(name, unit, values) for name, unit, values in rows)
    return (
        f'<div style="{_STYLE}"><table style="width:100%;border-collapse:collapse">'
        f"<tr><th></th>{heads}</tr>{body}</table></div>"
    )


def _row(name: str, unit: str, values: Iterable[float]) -> str:
    cells = "".join(
        f'<td style="text-align:right" data-joint="{name}{k + 1}">{value + 0.0:.2f}</td>'
        for k, value in enumerate(values)
    )
    return f'<tr><td>{name} <span style="color:#777">{unit}</span></td>{cells}</tr>'


def _healthy(health: Health) -> str:
    lines = [
        f'<tr><td colspan="2" style="color:{_LIGHTS[health.level]}">{escape(health.said)}</td>'
    ]
    for key, (name, unit, form) in SHOWN.items():
        if key in health.values:
            value = f"{_formatted(health.values[key], form)} {unit}"
            lines.append(f'<tr><td>{name}</td><td style="text-align:right">{value}</td>')
    for key in ("integrator", "fault"):
        if health.values.get(key):
            lines.append(f"<tr><td>{key}</td><td>{escape(health.values[key])}</td>")
    return (
        f'<div style="{_STYLE}"><table style="width:100%">{"</tr>".join(lines)}</tr></table></div>'
    )


def _formatted(text: str, form: str) -> str:
    try:
        return format(float(text), form)
    except ValueError:
        return escape(text)
