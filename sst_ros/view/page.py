# SPDX-License-Identifier: Apache-2.0
"""The page: a local web server by viser, fed from a source some thirty times a second."""

from __future__ import annotations

import os
import threading
import time
import webbrowser
from collections.abc import Iterator

import numpy as np

from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.view.buttons import PlaybackButtons, RunButtons, buttons
from sst_ros.view.panel import Panel
from sst_ros.view.scene_drawing import SceneDrawing
from sst_ros.view.server import LOCAL, PORT, PageServer
from sst_ros.view.source import Playback, RunControl, ViewState

PERIOD_S = 1.0 / 30.0
_SHOW_EVERY, _DRAW_EVERY = 3, 6
_PANEL_WIDTH = 400.0


class Page:
    """One source on one page. `close` ends it.

    Attributes:
        url: its address, with the access token.

    Raises:
        InputError: the host is no address of this machine, or no port is free.

    """

    def __init__(self, source: RunControl | Playback, host: str = LOCAL, port: int = PORT) -> None:
        self._source = source
        self._server = PageServer(host, port)
        self.url = self._server.url
        _arrange(self._server)
        self._parts: tuple[SceneDrawing, Panel, RunButtons | PlaybackButtons] | None = None
        self._scene: Scene | None = None
        self._state: ViewState | None = None
        self._waiting = self._server.gui.add_markdown("Waiting for a simulator ...")
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
        for count in _frames(self._stop):
            self._update(count)

    def _update(self, count: int) -> None:
        scene = self._source.scene
        if scene is not None and scene != self._scene:
            self._build(scene)
        if self._parts is None:
            return
        drawing, panel, pressed = self._parts
        with self._server.atomic():
            for state in self._source.states():
                drawing.add(state)
                panel.add(state)
                self._state = state
            if self._state is not None:
                drawing.show(self._state)
            if count % _SHOW_EVERY == 0:
                status = self._source.status()
                pressed.show(self._state, status)
                if self._state is not None:
                    panel.show(self._state, status)
            if count % _DRAW_EVERY == 0:
                panel.draw()

    def _build(self, scene: Scene) -> None:
        """Show another scene."""
        for part in self._parts or ():
            part.remove()
        self._waiting.visible = False
        self._scene, self._state = scene, None
        server = self._server
        self._parts = (
            SceneDrawing(server, scene),
            Panel(server, scene),
            buttons(server, scene, self._source),
        )
        middle = Geometry.of(scene).v.sum(axis=0)
        middle /= np.linalg.norm(middle)
        size = max(scene.base.radius, scene.star.radius)
        camera = server.initial_camera
        camera.fov = np.radians(35.0)
        camera.look_at = 0.28 * size * middle
        camera.position = size * (3.9 * middle + np.array([0.35, -0.55, 0.5]))
        for client in server.get_clients().values():
            client.camera.position, client.camera.look_at = camera.position, camera.look_at
            client.camera.fov = camera.fov


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


def _frames(stop: threading.Event) -> Iterator[int]:
    """Count at the rate of the page until it is stopped; late frames are dropped."""
    count, due = 0, time.monotonic()
    while not stop.is_set():
        yield count
        count += 1
        due = max(due + PERIOD_S, time.monotonic())
        stop.wait(max(0.0, due - time.monotonic()))
