# SPDX-License-Identifier: Apache-2.0
"""The page: a picture by viser, numbers, plots and controls, some thirty times a second."""

from __future__ import annotations

import itertools
import os
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Callable
from typing import Any

import jinja2
import numpy as np
from viser import GuiButtonHandle, GuiSliderHandle, GuiUplotHandle, Icon, ViserServer, uplot

from sst_ros.description.robot import LEG_COLOURS
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.view.scene_drawing import SceneDrawing
from sst_ros.view.server import LOCAL, PORT, PageServer
from sst_ros.view.source import Replay, RunControl, RunStatus, ViewState

PERIOD_S = 1.0 / 30.0
_SHOW_EVERY, _DRAW_EVERY = 3, 6  # frames between two updates of the numbers, and of the plots
_PANEL_WIDTH = 400.0
_LARGEST_TORQUE = 5.0  # range of the torque sliders where the scene has no limit [N m]
_SPEEDS = ("0.1 ×", "0.25 ×", "0.5 ×", "1 ×", "2 ×", "5 ×")
_REFUSAL_S = 4.0
_WINDOW_S = 10.0
_POINTS = 500
_COLOURS = tuple("#" + "".join(f"{round(255 * x):02x}" for x in rgb) for rgb in LEG_COLOURS)
_LEVELS = ("#2b8a3e", "#e67700", "#c92a2a")

_templates = jinja2.Environment(
    loader=jinja2.PackageLoader("sst_ros.view"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
)
_PANEL: Any = _templates.get_template("panel.html").module


class Page:
    """One source on one page, at `url`, which has the access token; `close` ends it.

    Raises:
        InputError: the host is no address of this machine, or no port is free.

    """

    def __init__(self, source: RunControl | Replay, host: str = LOCAL, port: int = PORT) -> None:
        self._source = source
        self._server = PageServer(host, port)
        self.url = self._server.url
        _arrange(self._server)
        self._server.gui.add_markdown("Waiting for a simulator ...")
        self._parts: tuple[SceneDrawing, _Panel, _RunControls | _ReplayControls] | None = None
        self._scene: Scene | None = None
        self._state: ViewState | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, name="page", daemon=True)
        self._thread.start()

    def announce(self, *, opened: bool) -> None:
        """Print the URL; `opened` also opens it, where there is a desktop."""
        print(f"the page is at {self.url}", flush=True)
        if opened and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(self.url)

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        self._thread.join()
        self._server.stop()

    def _live(self) -> None:
        due = time.monotonic()
        for count in itertools.count():
            self._update(count)
            due = max(due + PERIOD_S, time.monotonic())  # late frames are dropped
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return

    def _update(self, count: int) -> None:
        scene = self._source.scene
        if scene is not None and scene != self._scene:
            self._build(scene)
        if self._parts is None:
            return
        drawing, panel, controls = self._parts
        with self._server.atomic():
            for state in self._source.states():
                drawing.add(state.time, state.angles)
                panel.add(state)
                self._state = state
            if self._state is not None:
                drawing.show(self._state.angles, self._state.torque)
            if count % _SHOW_EVERY == 0:
                status = self._source.status()
                panel.show(self._state, status)
                controls.show(self._state, status)
            if count % _DRAW_EVERY == 0:
                panel.draw()

    def _build(self, scene: Scene) -> None:
        """Show another scene in place of the last."""
        server, source = self._server, self._source
        if self._parts is not None:
            self._parts[0].remove()
        server.gui.reset()
        _arrange(server)
        self._scene, self._state = scene, None
        controls = (
            _ReplayControls(server, source)
            if isinstance(source, Replay)
            else _RunControls(server, scene, source)
        )
        self._parts = SceneDrawing(server, scene), _Panel(server, scene), controls
        middle = Geometry.of(scene).v.sum(axis=0)
        middle /= np.linalg.norm(middle)
        size = max(scene.base.radius, scene.star.radius)
        cameras: list[Any] = [client.camera for client in server.get_clients().values()]
        for camera in (server.initial_camera, *cameras):
            camera.position = size * (3.9 * middle + np.array([0.35, -0.55, 0.5]))
            camera.look_at, camera.fov = 0.28 * size * middle, np.radians(35.0)


def _arrange(server: PageServer) -> None:
    """Set the theme, the panel's place and the light."""
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, brand_color=(0, 114, 178), control_width="large"
    )
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_PANEL_WIDTH)
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.set_up_direction("+z")


class _Panel:
    """The numbers beside the picture: state, joints, status, and plots of gamma and torque."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        gui = server.gui
        self._scene = scene
        self._head = gui.add_html("", order=0.0)
        self._joints = gui.add_html("", order=2.0)
        with gui.add_folder("actuator angles γ, last 10 s", order=3.0):
            self._gamma = _plot(server, "γ [deg]", (0.0, 90.0))
        with gui.add_folder("torques τ, last 10 s", order=4.0):
            self._torque = _plot(server, "τ [N m]", (-1.0, 1.0))
        with gui.add_folder("status of the run", order=6.0):
            self._status = gui.add_html("")
        self._rows: deque[tuple[float, ...]] = deque(maxlen=_POINTS)

    def add(self, state: ViewState) -> None:
        """Add a state to the plots; a time that goes back begins new ones."""
        if state.time is None:
            return
        if self._rows and state.time < self._rows[-1][0]:
            self._rows.clear()
        if not self._rows or state.time - self._rows[-1][0] >= _WINDOW_S / _POINTS:
            self._rows.append((state.time, *np.degrees(state.gamma), *state.torque))

    def show(self, state: ViewState | None, status: RunStatus) -> None:
        """Show name, phase and time, and the numbers of a state."""
        phase = status.phase or "no simulator"
        colour = _LEVELS[2 if phase.startswith("fault") else status.level]
        time = "–" if state is None or state.time is None else f"{state.time:.2f} s"
        self._head.content = str(_PANEL.head(self._scene, phase, colour, time))
        if state is None:
            return
        self._joints.content = str(_PANEL.joints(_COLOURS, state))
        shown = _PANEL.status(_LEVELS[status.level], status.message, status.values)
        self._status.content = str(shown)

    def draw(self) -> None:
        """Draw the plots."""
        if len(self._rows) < 2:
            return
        rows = np.array(self._rows)
        rows = rows[rows[:, 0] > rows[-1, 0] - _WINDOW_S]
        for plot, columns in ((self._gamma, rows[:, 1:4]), (self._torque, rows[:, 4:7])):
            plot.data = (rows[:, 0], *columns.T.copy())


def _plot(server: ViserServer, label: str, range_: tuple[float, float]) -> GuiUplotHandle:
    """Add a plot of three legs whose axis shows a range at least."""
    lines: list[uplot.Series] = [{"label": "t [s]"}]
    for k, colour in zip("₁₂₃", _COLOURS, strict=True):
        lines.append({"label": f"{label[0]}{k}", "stroke": colour, "width": 2.0})
    low, high = ({"soft": value, "mode": 1, "pad": 0.1} for value in range_)
    return server.gui.add_uplot(
        (np.array([0.0, 1.0]), *np.zeros((3, 2))),
        tuple(lines),
        scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
        axes=({"label": "t [s]", "labelSize": 16, "size": 26}, {"label": label, "size": 44}),
        legend={"show": False},
        height=130,
    )


class _RunControls:
    """Pause, step, reset, and manual torques while no controller commands the run."""

    def __init__(self, server: ViserServer, scene: Scene, run: RunControl) -> None:
        self._run, self._paused = run, False
        gui = server.gui
        most = scene.torque_limit or _LARGEST_TORQUE
        with gui.add_folder("run", order=1.0):
            self._pause = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self._step = gui.add_button("Step", icon=Icon.PLAYER_SKIP_FORWARD, disabled=True)
            reset = gui.add_button("Reset", icon=Icon.REFRESH)
        with gui.add_folder("manual torques [N m]", order=5.0):
            self._note = gui.add_html("")
            self._sliders = [gui.add_slider(f"τ{k}", -most, most, most / 100.0, 0.0) for k in "₁₂₃"]
            self._zero = gui.add_button("Zero", icon=Icon.CIRCLE_OFF)
        _ask(self._pause, "pause", lambda: run.pause(not self._paused))
        _ask(self._step, "step", run.step)
        _ask(reset, "reset", self._reset)
        self._zero.on_click(lambda _: self._release())
        for slider in self._sliders:
            slider.on_update(lambda event: self._apply() if event.client is not None else None)

    def show(self, state: ViewState | None, status: RunStatus) -> None:
        """Enable what is possible now."""
        paused = status.phase == "paused"
        if paused != self._paused:
            self._paused = paused
            _name(self._pause, "Resume" if paused else "Pause")
            self._step.disabled = not paused
        controller = self._run.controller()
        note = str(_PANEL.commanded(controller)) if controller else ""
        if note != self._note.content:
            self._note.content = note
            for handle in (*self._sliders, self._zero):
                handle.disabled = bool(controller)

    def _apply(self) -> None:
        first, second, third = (float(slider.value) for slider in self._sliders)
        self._run.apply((first, second, third))

    def _release(self) -> None:
        for slider in self._sliders:
            _move(slider, 0.0)
        self._run.apply((0.0, 0.0, 0.0))

    def _reset(self) -> tuple[bool, str]:
        if any(slider.value for slider in self._sliders):
            self._release()
        return self._run.reset()


class _ReplayControls:
    """Play, a time slider, and the speed of a recording."""

    def __init__(self, server: ViserServer, replay: Replay) -> None:
        self._replay, self._playing = replay, True
        gui = server.gui
        with gui.add_folder("recording", order=1.0):
            self._play = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE)
            self._time = gui.add_slider("t [s]", 0.0, replay.length, replay.length / 1000.0, 0.0)
            speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")
        self._play.on_click(lambda _: replay.play(not replay.playing))
        self._time.on_update(
            lambda event: replay.seek(float(self._time.value)) if event.client is not None else None
        )
        speed.on_update(lambda _: replay.set_speed(float(speed.value.split()[0])))

    def show(self, state: ViewState | None, status: RunStatus) -> None:
        """Update button and slider."""
        before, playing = self._playing, self._replay.playing
        if playing != before:
            self._playing = playing
            _name(self._play, "Pause" if playing else "Play")
        if (playing or before) and state is not None and state.time is not None:
            _move(self._time, round(min(state.time, self._replay.length), 6))


def _name(button: GuiButtonHandle, label: str) -> None:
    button.label = label
    button.icon = Icon.PLAYER_PAUSE if label == "Pause" else Icon.PLAYER_PLAY


def _move(slider: GuiSliderHandle[float], value: float) -> None:
    slider.value = value  # type: ignore[misc]  # its setter does not follow its getter at once


def _ask(button: Any, name: str, act: Callable[[], tuple[bool, str]]) -> None:
    """Have a button act, and notify the client of a refusal."""

    def on_click(event: Any) -> None:
        done, message = act()
        if not done and event.client is not None:
            given: Any = {"auto_close_seconds": _REFUSAL_S, "color": "red"}
            event.client.add_notification(f"{name} refused", message, **given)

    button.on_click(on_click)
