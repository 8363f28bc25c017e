# SPDX-License-Identifier: Apache-2.0
"""The page: picture by viser, numbers, plots, controls, some thirty times a second.

The picture has seven links that rotate about O, the path of E, s, and torques.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sst_ros.description import robot
from sst_ros.files import load_templates
from sst_ros.mechanism.geometry import (
    Array,
    Geometry,
    quaternion_of,
    star_direction,
)
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO
from sst_ros.view.server import PageServer
from sst_ros.view.source import Replay, RunControl, ViewState

PERIOD_S = 1.0 / 30.0
"""Period of the frames."""
_SHOW_EVERY = 3
"""Frames between two updates of the numbers: faster ones could not be read."""
_DRAW_EVERY = 6
"""Frames between two updates of the plots."""
_PANEL_WIDTH = 400.0
_LARGEST_TORQUE = 5.0
"""Range of the torque sliders where the scene has no limit [N m]."""
_SPEEDS = ("0.1 ×", "0.25 ×", "0.5 ×", "1 ×", "2 ×", "5 ×")
_REFUSAL_S = 4.0
"""Time for which a refusal is shown."""
_WINDOW_S = 10.0
"""Time that the plots show."""
_CURVE_POINTS = 500
"""Points of a curve: about as many as it has pixels."""
_COLOURS = tuple(
    "#" + "".join(f"{round(255 * share):02x}" for share in colour)
    for colour in robot.LEG_COLOURS
)
"""Colours of the legs in HTML."""
_BRAND = (0, 114, 178)
_LEVELS = ("#2b8a3e", "#e67700", "#c92a2a")
"""Colours of a status that is OK, a warning or an error."""

ROOT = "/manipulator"
"""Node of viser's scene that has all that is drawn of the manipulator."""
PATH_POINTS = 400
"""Points by which the path of E is drawn."""
_POINT_PERIOD_S = 0.008
"""Least time between two of them."""
_PATH_S = 4.0
"""Time for which a point stays."""
_LIFT = np.linspace(1.006, 1.022, PATH_POINTS)[:, None]
"""The path lies a little outside the star, which would hide it.

Newer parts lie above older ones.
"""
_OLD_COLOUR = np.array([0.90, 0.86, 0.92])
_NEW_COLOUR = np.array([0.42, 0.00, 0.42])
"""Colours of the ends of the path; between them they blend."""
_SIDES = 20
"""Corners of an arc's cross-section."""

Show: TypeAlias = Callable[[str, float | None], None]
"""Shows the controls as they are in a phase, at a time [s]."""
_PANEL: Any = load_templates("view").get_template("panel.html").module


class _PlotSample(NamedTuple):
    """What the plots show of a state."""

    time: float  # [s]
    degrees: Array  # actuator angles [deg], shape (3,)
    torque: Sequence[float]  # [N m], shape (3,)


class _PageContents(NamedTuple):
    """A scene on the page, and what of the page changes while it is shown."""

    scene: Scene
    drawing: SceneDrawing
    show_controls: Show
    head: viser.GuiHtmlHandle  # name, phase and time
    joints: viser.GuiHtmlHandle  # numbers of the state
    status: viser.GuiHtmlHandle  # of the run
    angle_plot: viser.GuiUplotHandle
    torque_plot: viser.GuiUplotHandle


class Page:
    """One source on one page, at `url`, which has the access token; `close` ends it.

    Raises as `PageServer`.
    """

    def __init__(self, source: RunControl | Replay, host: str, port: int) -> None:
        self._source = source
        self._server = PageServer(host, port)
        self.url = self._server.url
        self._clear()
        # No markdown: viser sends its text as an update, which a slow browser complains
        # of where it gets the removal at once with it.
        self._server.gui.add_html("<small>&nbsp; Waiting for a simulator ...</small>")
        self._contents: _PageContents | None = None
        self._state: ViewState | None = None  # the last one
        self._samples: deque[_PlotSample] = deque(maxlen=_CURVE_POINTS)
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
        """Show the source, frame by frame, until the page is closed."""
        due = time.monotonic()
        for frame in itertools.count():
            scene = self._source.scene
            if scene is not None and not self._shows(scene):
                self._contents = self._build(scene)
            if self._contents is not None:
                with self._server.atomic():
                    self._update(self._contents, frame)
            due = max(due + PERIOD_S, time.monotonic())  # late frames are dropped
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return

    def _shows(self, scene: Scene) -> bool:
        return self._contents is not None and self._contents.scene == scene

    def _clear(self) -> None:
        """Empty the page; set the theme, the panel's place and the light."""
        gui = self._server.gui
        scene = self._server.scene
        gui.reset()
        gui.configure_theme(
            brand_color=_BRAND,
            control_width="large",
            show_logo=False,
            show_share_button=False,
        )
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_WIDTH)
        scene.remove_by_name(ROOT)
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(None)
        scene.set_up_direction("+z")

    def _build(self, scene: Scene) -> _PageContents:
        """Replace what is shown by a scene: picture, numbers, plots and controls."""
        self._clear()
        self._state = None
        self._samples.clear()
        server = self._server
        gui = server.gui
        if isinstance(self._source, Replay):
            show_controls = _add_replay_controls(server, self._source)
        else:
            show_controls = _add_run_controls(server, scene, self._source)
        drawing = SceneDrawing(server, scene)
        head = gui.add_html("", order=0.0)
        joints = gui.add_html("", order=2.0)
        with gui.add_folder("actuator angles γ, last 10 s", order=3.0):
            angle_plot = _plot(server, "γ [deg]", (0.0, 90.0))
        with gui.add_folder("torques τ, last 10 s", order=4.0):
            torque_plot = _plot(server, "τ [N m]", (-1.0, 1.0))
        with gui.add_folder("status of the run", order=6.0):
            status = gui.add_html("")
        self._place_cameras(scene)
        return _PageContents(
            scene=scene,
            drawing=drawing,
            show_controls=show_controls,
            head=head,
            joints=joints,
            status=status,
            angle_plot=angle_plot,
            torque_plot=torque_plot,
        )

    def _place_cameras(self, scene: Scene) -> None:
        """Look at the manipulator from outside, over the middle of the base."""
        middle = Geometry.of(scene).v.sum(axis=0)
        middle /= np.linalg.norm(middle)
        size = max(scene.base.radius, scene.star.radius)
        clients = self._server.get_clients().values()
        cameras: list[Any] = [client.camera for client in clients]
        for camera in (self._server.initial_camera, *cameras):
            camera.position = size * (3.9 * middle + np.array([0.35, -0.55, 0.5]))
            camera.look_at = 0.28 * size * middle
            camera.fov = np.radians(35.0)

    def _update(self, contents: _PageContents, frame: int) -> None:
        """Take what is new, and show it where it is due."""
        for state in self._source.states():
            contents.drawing.add(state.time, state.angles)
            self._add_to_plots(state)
            self._state = state
        if self._state is not None:
            contents.drawing.show(self._state.angles, self._state.torque)
        if frame % _SHOW_EVERY == 0:
            self._show_numbers(contents)
        if frame % _DRAW_EVERY == 0 and len(self._samples) >= 2:
            self._draw_plots(contents)

    def _draw_plots(self, contents: _PageContents) -> None:
        """Show the samples of the last ten seconds."""
        begin = self._samples[-1].time - _WINDOW_S
        samples = [sample for sample in self._samples if sample.time > begin]
        times = np.array([sample.time for sample in samples])
        degrees = np.array([sample.degrees for sample in samples])
        torques = np.array([sample.torque for sample in samples])
        contents.angle_plot.data = (times, *degrees.T.copy())
        contents.torque_plot.data = (times, *torques.T.copy())

    def _add_to_plots(self, state: ViewState) -> None:
        """Add a state to the plots; a time that goes back begins new ones."""
        if state.time is None:
            return
        if self._samples and state.time < self._samples[-1].time:
            self._samples.clear()
        spacing = _WINDOW_S / _CURVE_POINTS
        if not self._samples or state.time - self._samples[-1].time >= spacing:
            degrees = np.degrees(state.gamma)
            self._samples.append(_PlotSample(state.time, degrees, state.torque))

    def _show_numbers(self, contents: _PageContents) -> None:
        """Show name, phase, time, numbers of the state, and what is possible now."""
        state = self._state
        status = self._source.status()
        phase = status.phase or "no simulator"
        time = None if state is None else state.time
        time_text = "–" if time is None else f"{time:.2f} s"
        level = 2 if phase.startswith("fault") else status.level
        head = _PANEL.head(contents.scene, phase, _LEVELS[level], time_text)
        contents.head.content = str(head)
        if state is not None:
            contents.joints.content = str(_PANEL.joints(_COLOURS, state))
            panel = _PANEL.status(_LEVELS[status.level], status.message, status.values)
            contents.status.content = str(panel)
        contents.show_controls(phase, time)


def _plot(
    server: PageServer, label: str, range_: tuple[float, float]
) -> viser.GuiUplotHandle:
    """Add a plot of three legs whose axis shows a range at least."""
    lines: list[viser.uplot.Series] = [{"label": "t [s]"}]
    for k, colour in zip("₁₂₃", _COLOURS, strict=True):
        lines.append({"label": f"{label[0]}{k}", "stroke": colour, "width": 2.0})
    least, largest = range_
    low = {"soft": least, "mode": 1, "pad": 0.1}
    high = {"soft": largest, "mode": 1, "pad": 0.1}
    return server.gui.add_uplot(
        (np.array([0.0, 1.0]), *np.zeros((3, 2))),
        tuple(lines),
        scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
        axes=(
            {"label": "t [s]", "labelSize": 16, "size": 26},
            {"label": label, "size": 44},
        ),
        legend={"show": False},
        height=130,
    )


def _add_run_controls(server: PageServer, scene: Scene, run: RunControl) -> Show:
    """Add pause, step, reset, and manual torques while no controller commands the run.

    The function returned enables what is possible in a phase.
    """
    gui = server.gui
    most = scene.torque_limit or _LARGEST_TORQUE
    with gui.add_folder("run", order=1.0):
        pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        step = gui.add_button(
            "Step", icon=viser.Icon.PLAYER_SKIP_FORWARD, disabled=True
        )
        reset = gui.add_button("Reset", icon=viser.Icon.REFRESH)
    with gui.add_folder("manual torques [N m]", order=5.0):
        note = gui.add_html("")
        sliders = [
            gui.add_slider(f"τ{k}", -most, most, most / 100.0, 0.0) for k in "₁₂₃"
        ]
        zero = gui.add_button("Zero", icon=viser.Icon.CIRCLE_OFF)

    def ask(event: Any) -> None:
        """Ask for what a button says, and notify its client of a refusal."""
        if event.target is reset and any(slider.value for slider in sliders):
            release(event)
        name = event.target.label.lower()
        accepted, message = run.ask(name)
        if not accepted and event.client is not None:
            look: Any = {"auto_close_seconds": _REFUSAL_S, "color": "red"}
            event.client.add_notification(f"{name} refused", message, **look)

    def apply(event: Any) -> None:
        """Hold the torques of the sliders, where a person has moved one."""
        if event.client is not None:
            first, second, third = (float(slider.value) for slider in sliders)
            run.apply((first, second, third))

    def release(_: Any) -> None:
        """Move all sliders to zero, and hold no torque."""
        for slider in sliders:
            _move(slider, 0.0)
        run.apply(ZERO)

    def show(phase: str, _: float | None) -> None:
        """Name the button, and enable what is possible."""
        if (phase == "paused") != (pause.label == "Resume"):
            _name(pause, "Resume" if phase == "paused" else "Pause")
            step.disabled = phase != "paused"
        controller = run.controller()
        text = str(_PANEL.commanded(controller)) if controller else ""
        if text != note.content:
            note.content = text
            for handle in (*sliders, zero):
                handle.disabled = bool(controller)

    for button in (pause, step, reset):
        button.on_click(ask)
    for slider in sliders:
        slider.on_update(apply)
    zero.on_click(release)
    return show


def _add_replay_controls(server: PageServer, replay: Replay) -> Show:
    """Add play, a time slider, and the speed of a recording.

    The function returned moves them.
    """
    gui = server.gui
    with gui.add_folder("recording", order=1.0):
        play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        slider = gui.add_slider(
            "t [s]", 0.0, replay.length, replay.length / 1000.0, 0.0
        )
        speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")

    def seek(event: Any) -> None:
        if event.client is not None:
            replay.seek(float(slider.value))

    def show(_: str, time: float | None) -> None:
        was_playing = play.label == "Pause"
        playing = replay.playing
        if playing != was_playing:
            _name(play, "Pause" if playing else "Play")
        if (playing or was_playing) and time is not None:
            _move(slider, round(min(time, replay.length), 6))

    play.on_click(lambda _: replay.play(not replay.playing))
    slider.on_update(seek)
    speed.on_update(lambda _: replay.set_speed(float(speed.value.split()[0])))
    return show


def _name(button: viser.GuiButtonHandle, label: str) -> None:
    button.label = label
    button.icon = (
        viser.Icon.PLAYER_PAUSE if label == "Pause" else viser.Icon.PLAYER_PLAY
    )


def _move(slider: viser.GuiSliderHandle[float], value: float) -> None:
    slider.value = value  # type: ignore[misc]  # its setter does not follow its getter at once


class SceneDrawing:
    """One scene as drawn, in nodes below ROOT."""

    def __init__(self, server: viser.ViserServer, scene: Scene) -> None:
        self._server = server
        self._scene = scene
        self._geometry = Geometry.of(scene)
        self._joints = robot.joints_of(self._geometry)
        # those of leg 1, which lead to the star
        self._joints_to_star = [
            joint for joint in self._joints if joint.name.endswith("_1")
        ]
        self._frames = {}
        for link, drawn in robot.shapes(scene).items():
            self._frames[link] = server.scene.add_frame(
                f"{ROOT}/{link}", show_axes=False
            )
            for index, shape in enumerate(drawn):
                add_shape(server, f"{ROOT}/{link}/{index}", shape)
        self._size = max(scene.base.radius, scene.star.radius)
        self._add_labels()
        self._points: deque[tuple[float, Array]] = deque(maxlen=PATH_POINTS)
        self._last = -np.inf
        fade = np.linspace(0.0, 1.0, PATH_POINTS)[:, None]
        colours = (1.0 - fade) * _OLD_COLOUR + fade * _NEW_COLOUR
        self._path = server.scene.add_line_segments(
            f"{ROOT}/path",
            np.zeros((PATH_POINTS - 1, 2, 3)),
            np.stack([colours[:-1], colours[1:]], axis=1),
            thickness=0.016 * self._size,
        )
        outward = scene.star.radius * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.28]])
        self._add_arrow(
            f"{robot.STAR_LINK}/s", outward, robot.STAR_COLOUR, (0.010, 0.028, 0.075)
        )
        self._torques = [
            self._add_arrow(
                f"torque_{k}", np.zeros((2, 3)), colour, (0.014, 0.040, 0.090)
            )
            for k, colour in enumerate(robot.LEG_COLOURS, 1)
        ]
        for arrow in self._torques:
            arrow.visible = False
        self._largest_torque = 1.0

    def add(self, time: float | None, angles: Mapping[str, float]) -> None:
        """Add E at a time [s] and joint angles [rad] to the path.

        A time that goes back begins a new path, and so does None: there is no run.
        """
        if time is None or time < self._last:
            self._points.clear()
            self._last = -np.inf
        if time is not None and time - self._last >= _POINT_PERIOD_S:
            self._last = time
            rotations = robot.rotations(self._joints_to_star, angles)
            self._points.append((time, self._position_of_e(rotations)))
            while self._points[0][0] < time - _PATH_S:
                self._points.popleft()

    def show(self, angles: Mapping[str, float], torque: Sequence[float]) -> None:
        """Move everything to joint angles [rad], and show torques [N m], shape (3,)."""
        rotations = robot.rotations(self._joints, angles)
        for link, frame in self._frames.items():
            frame.wxyz = wxyz(rotations[link])
        self._show_path(self._position_of_e(rotations))
        # The largest torque yet has an arrow of full length.
        self._largest_torque = max(self._largest_torque, *map(abs, torque))
        for arrow, tau, w in zip(self._torques, torque, self._geometry.w, strict=True):
            self._show_torque(arrow, tau, w)

    def _position_of_e(self, rotations: Mapping[str, Array]) -> Array:
        """Return the position of E in {B} [m], shape (3,), by the links' rotations."""
        return self._scene.star.radius * star_direction(rotations[robot.STAR_LINK])

    def _show_path(self, end: Array) -> None:
        """Show the points of the path and E, shape (3,); the first fills the rest."""
        path = [point for _, point in self._points]
        points = np.array([*path, end])[-PATH_POINTS:]
        filling = np.repeat(points[:1], PATH_POINTS - len(points), axis=0)
        points = np.concatenate([filling, points])
        points *= _LIFT
        segments = np.stack([points[:-1], points[1:]], axis=1)
        self._path.points = segments.astype(np.float32)

    def _show_torque(self, arrow: viser.ArrowsHandle, tau: float, w: Array) -> None:
        """Show a torque tau_k along w_k, outwards where it is positive."""
        length = 0.45 * self._size * abs(tau) / self._largest_torque
        visible = length > 0.01 * self._size
        if visible:
            foot = 1.17 * self._scene.base.radius
            ends = np.array([foot * w, (foot + length) * w])
            if tau <= 0.0:
                ends = ends[::-1]
            arrow.points = ends.astype(np.float32)[None]
        arrow.visible = visible

    def _add_arrow(
        self,
        name: str,
        ends: Array,
        colour: ArrayLike,
        sizes: tuple[float, float, float],
    ) -> viser.ArrowsHandle:
        """Add an arrow between two points.

        Sizes of shaft and head are shares of the larger radius, of base or star.

        viser takes linear colours for arrows, and sRGB for all else.
        """
        shaft, head, length = (self._size * size for size in sizes)
        linear = np.asarray(colour, dtype=float) ** 2.2
        arrow_sizes: Any = {
            "shaft_radius": shaft,
            "head_radius": head,
            "head_length": length,
        }
        return self._server.scene.add_arrows(
            f"{ROOT}/{name}", ends[None], linear, **arrow_sizes
        )

    def _add_labels(self) -> None:
        """Name the vertices P_k of the base triangle, on its outer side, and E."""
        v = self._geometry.v
        outwards = v - v.mean(axis=0)
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        points = self._scene.base.radius * (v + 0.13 * outwards)
        for k, position in enumerate(points, 1):
            self._add_label(f"{robot.BASE}/P{k}", f"P{'₁₂₃'[k - 1]}", position)
        end = self._scene.star.radius * np.array([0.0, 0.0, 1.36])
        self._add_label(f"{robot.STAR_LINK}/E", "E", end)

    def _add_label(self, name: str, text: str, position: Array) -> None:
        self._server.scene.add_label(
            f"{ROOT}/{name}",
            text,
            position=position,
            anchor="center-center",
            font_screen_scale=2.0,
        )


def add_shape(server: viser.ViserServer, name: str, shape: robot.Shape) -> None:
    """Add a shape to viser's scene under a name."""
    scene = server.scene
    if isinstance(shape, robot.Ball):
        scene.add_icosphere(
            name, shape.radius, shape.colour, position=shape.centre,
            # of an edge of the icosahedron
            subdivisions=3 if shape.radius < 0.1 else 20,
            opacity=shape.opacity if shape.opacity < 1.0 else None,
        )  # fmt: skip
    elif isinstance(shape, robot.Box):
        scene.add_box(name, shape.colour, shape.size, position=shape.centre)
    elif isinstance(shape, robot.Arc):
        _add_arc(server, name, shape)
    else:
        along = shape.end - shape.begin
        turn, _ = Rotation.align_vectors(along, [0.0, 0.0, 1.0])
        scene.add_cylinder(
            name,
            shape.thickness,
            float(np.linalg.norm(along)),
            shape.colour,
            position=(shape.begin + shape.end) / 2.0,
            wxyz=wxyz(turn.as_matrix()),
        )


def _add_arc(server: viser.ViserServer, name: str, arc: robot.Arc) -> None:
    """Add a round bar along an arc, with a ball at each end."""
    turns = 2.0 * np.pi * np.arange(_SIDES + 1) / _SIDES
    outline = np.stack([np.cos(turns), np.sin(turns)], axis=1) * arc.thickness
    mesh = trimesh.creation.revolve(
        outline + np.array([arc.radius, 0.0]),
        angle=arc.angle,
        sections=len(arc.points()),
    )
    across = np.cross(arc.axis, arc.begin)
    frame = np.stack([arc.begin, across, arc.axis], axis=1)
    vertices = mesh.vertices @ frame.T
    server.scene.add_mesh_simple(name, vertices, mesh.faces, color=arc.colour)
    for index, end in enumerate(arc.points()[[0, -1]]):
        ball = robot.Ball(end, arc.thickness, arc.colour)
        add_shape(server, f"{name}/{index}", ball)


def wxyz(rotation: Array) -> Array:
    """Quaternion (w, x, y, z), as viser takes it, of a rotation matrix."""
    return np.roll(quaternion_of(rotation), 1)
