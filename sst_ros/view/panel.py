# SPDX-License-Identifier: Apache-2.0
"""The numbers beside the picture: state, joints, status, and plots of gamma and torque."""

from __future__ import annotations

from collections import deque

import jinja2
import numpy as np
from viser import GuiUplotHandle, ViserServer, uplot

from sst_ros.description.shapes import LEG_COLOURS
from sst_ros.scene.scene import Scene
from sst_ros.view.source import RunStatus, ViewState

WINDOW_S = 10.0
_POINTS = 500
_COLOURS = tuple("#" + "".join(f"{round(255 * x):02x}" for x in rgb) for rgb in LEG_COLOURS)
_LEVELS = ("#2b8a3e", "#e67700", "#c92a2a")
SHOWN = {
    "error_estimate": ("error estimate", "rad", ".1e"),
    "energy_residual_J": ("energy residual", "J", ".1e"),
    "closure_residual": ("loop-closure error", "", ".1e"),
    "real_time_factor_now": ("real-time factor", "", ".3f"),
    "step_mean_us": ("mean step", "µs", ".0f"),
    "ticks_missed": ("missed ticks", "", ".0f"),
    "commands_dropped": ("commands dropped", "", ".0f"),
    "integrator": ("integrator", "", ""),
    "fault": ("fault", "", ""),
}
"""Diagnostics that are shown: label, unit, format."""

_STYLE = (
    "font-size:13px;line-height:1.5;padding:2px 10px;font-variant-numeric:tabular-nums;"
    "overflow-wrap:anywhere"
)
_templates = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
_HEAD = _templates.from_string("""
<div style="{{ style }}"><div style="font-size:15px"><b>{{ scene.name }}</b></div>
<div style="color:#555">{{ scene.description }}</div>
<div style="font-size:15px"><b id="sst-phase" style="color:{{ colour }}">{{ phase }}</b>
&nbsp; t = <span id="sst-time">{{ time }}</span></div></div>
""")
_JOINTS = _templates.from_string("""
<div style="{{ style }}"><table style="width:100%;border-collapse:collapse"><tr><th></th>
{% for colour in colours %}
<th style="color:{{ colour }};text-align:right;width:24%">leg {{ loop.index }}</th>
{% endfor %}
</tr>
{% for name, unit, values in rows %}
<tr><td>{{ name }} <span style="color:#777">{{ unit }}</span></td>
{% for value in values %}
<td style="text-align:right" data-joint="{{ name }}{{ loop.index }}">{{ "%.2f" % value }}</td>
{% endfor %}
</tr>
{% endfor %}
</table></div>
""")
_STATUS = _templates.from_string("""
<div style="{{ style }}"><table style="width:100%">
<tr><td colspan="2" style="color:{{ colour }}">{{ message }}</td></tr>
{% for label, value in rows %}
<tr><td>{{ label }}</td><td style="text-align:right">{{ value }}</td></tr>
{% endfor %}
</table></div>
""")


class Panel:
    """All of it, for one scene."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        gui = server.gui
        self._scene = scene
        self._head = gui.add_html(head(scene, None, RunStatus()), order=0.0)
        self._joints = gui.add_html("", order=2.0)
        with gui.add_folder("actuator angles γ, last 10 s", order=3.0) as first:
            self._gamma = _plot(server, "γ [deg]", (0.0, 90.0))
        with gui.add_folder("torques τ, last 10 s", order=4.0) as second:
            self._torque = _plot(server, "τ [N m]", (-1.0, 1.0))
        with gui.add_folder("status of the run", order=6.0) as third:
            self._status = gui.add_html("")
        self._owned = (self._head, self._joints, first, second, third)
        self._rows: deque[tuple[float, ...]] = deque(maxlen=_POINTS)

    def remove(self) -> None:
        """Take it off the page."""
        for handle in self._owned:
            handle.remove()

    def add(self, state: ViewState) -> None:
        """Add a state to the plots; a time that goes back begins new ones."""
        if state.time is None:
            return
        if self._rows and state.time < self._rows[-1][0]:
            self._rows.clear()
        if not self._rows or state.time - self._rows[-1][0] >= WINDOW_S / _POINTS:
            self._rows.append((state.time, *np.degrees(state.gamma), *state.torque))

    def show(self, state: ViewState, status: RunStatus) -> None:
        """Show the numbers of a state."""
        self._head.content = head(self._scene, state, status)
        self._joints.content = joints(state)
        self._status.content = diagnostics(status)

    def draw(self) -> None:
        """Draw the plots."""
        if len(self._rows) < 2:
            return
        rows = np.array(self._rows)
        rows = rows[rows[:, 0] > rows[-1, 0] - WINDOW_S]
        for plot, columns in ((self._gamma, rows[:, 1:4]), (self._torque, rows[:, 4:7])):
            plot.data = (rows[:, 0], *columns.T.copy())


def head(scene: Scene, state: ViewState | None, status: RunStatus) -> str:
    """Return name, description, phase and time as HTML."""
    phase = status.phase or "no simulator"
    return _HEAD.render(
        style=_STYLE,
        scene=scene,
        phase=phase,
        colour=_LEVELS[2 if phase.startswith("fault") else status.level],
        time="–" if state is None or state.time is None else f"{state.time:.2f} s",
    )


def joints(state: ViewState) -> str:
    """Return the table of the joints as HTML."""
    rows = (
        ("γ", "deg", np.degrees(state.gamma)),
        ("γ̇", "rad/s", state.gamma_dot),
        ("τ", "N m", state.torque),
        ("μ", "deg", np.degrees(state.mu)),
        ("β", "deg", np.degrees(state.beta)),
    )
    shown = [(name, unit, [float(x) + 0.0 for x in values]) for name, unit, values in rows]
    return _JOINTS.render(style=_STYLE, colours=_COLOURS, rows=shown)


def diagnostics(status: RunStatus) -> str:
    """Return message and diagnostics of a run as HTML."""
    rows = [
        (label, f"{_formatted(status.values[key], form)} {unit}")
        for key, (label, unit, form) in SHOWN.items()
        if status.values.get(key)
    ]
    colour = _LEVELS[status.level]
    return _STATUS.render(style=_STYLE, colour=colour, message=status.message, rows=rows)


def _plot(server: ViserServer, label: str, range_: tuple[float, float]) -> GuiUplotHandle:
    """Add a plot of three legs whose axis shows a range at least."""
    empty = np.array([0.0, 1.0])
    lines: list[uplot.Series] = [{"label": "t [s]"}]
    for k, colour in enumerate(_COLOURS):
        lines.append({"label": f"{label[0]}{'₁₂₃'[k]}", "stroke": colour, "width": 2.0})
    ends = {
        end: {"soft": value, "mode": 1, "pad": 0.1}
        for end, value in zip(("min", "max"), range_, strict=True)
    }
    return server.gui.add_uplot(
        (empty, *(np.zeros(2) for _ in range(3))),
        tuple(lines),
        scales={"x": {"time": False}, "y": {"range": ends}},
        axes=({"label": "t [s]", "labelSize": 16, "size": 26}, {"label": label, "size": 44}),
        legend={"show": False},
        height=130,
    )


def _formatted(text: str, form: str) -> str:
    try:
        return format(float(text), form) if form else text
    except ValueError:
        return text
