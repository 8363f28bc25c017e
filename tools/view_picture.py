# SPDX-License-Identifier: Apache-2.0
"""The mechanism as built, with its frames: `python -m tools.view_picture docs/mechanism.png`.

The frames of the paper have their origins at O; {1k}, {2k} and {E} are drawn on their links,
where they can be distinguished; their axes are x red, y green, z blue.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np

from sst_ros.description.tree import BASE, LEGS, STAR, end_point, name_actuated, name_intermediate
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from sst_ros.view.scene_drawing import SceneDrawing
from sst_ros.view.server import PageServer
from sst_ros.view.source import ViewState
from tools.browser import browse

SCENE = "example2"
SIZE = (1440, 1200)
WIDTH = 1080
_PORT = 18400
_ALONG = np.radians(58.0)
"""Where {1k} is drawn on its bar, from the carriage towards the motor."""


def picture(path: Path) -> None:
    """Write the picture as PNG.

    Raises:
        SstError: there is no browser.

    """
    from PIL import Image

    scene = load(SCENE)
    server = PageServer(port=_PORT)
    try:
        _build(server, scene)
        with browse() as page:
            page.open(server.url, SIZE)
            page.hide(".mantine-Notification-root, .mantine-Paper-root, .mantine-ActionIcon-root")
            for _ in range(10):
                page.drawn()
            taken = Image.open(io.BytesIO(page.picture())).convert("RGB")
    finally:
        server.stop()
    size = (WIDTH, WIDTH * SIZE[1] // SIZE[0])
    taken.resize(size, Image.Resampling.LANCZOS).save(path, optimize=True)


def _build(server: PageServer, scene: Scene) -> None:
    """Draw the scene in its initial pose, without the globe that hides O, and the frames."""
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.set_up_direction("+z")
    drawing = SceneDrawing(server, scene)
    state = Simulation(scene).state
    at = state.joints
    drawing.show(ViewState(None, at.gamma, at.mu, at.beta, at.gamma_dot, (0.0, 0.0, 0.0)))
    for name in (f"{BASE}/0", f"{STAR}/s", f"{STAR}/E"):
        server.scene.remove_by_name(f"/manipulator/{name}")
    size = max(scene.base.radius, scene.star.radius)
    _add_frames(server, scene, size)
    middle = Geometry.of(scene).v.sum(axis=0)
    middle /= np.linalg.norm(middle)
    camera = server.initial_camera
    camera.fov = np.radians(32.0)
    camera.look_at = 0.32 * size * middle
    camera.position = size * (3.4 * middle + np.array([0.25, -1.1, 1.1]))


def _add_frames(server: PageServer, scene: Scene, size: float) -> None:
    thick, base, star = 0.02 * scene.base.radius, scene.base.radius, scene.star.radius
    end = end_point(scene, np.eye(3))
    bar = 1.04 * (base + 1.5 * thick) * np.array([np.cos(_ALONG), 0.0, np.sin(_ALONG)])
    places = {BASE: ("{B}", np.zeros(3), 0.42), STAR: ("{E}", 1.05 * end, 0.24)}
    for k in LEGS:
        places[name_actuated(k)] = (f"{{1{k}}}", bar, 0.15)
        places[name_intermediate(k)] = (f"{{2{k}}}", 1.07 * star * np.array([1.0, 0.0, 0.0]), 0.15)
    for link, (name, position, length) in places.items():
        node = f"/manipulator/{link}/axes"
        server.scene.add_frame(
            node, axes_length=length * size, axes_radius=0.010 * size, position=position,
            origin_radius=0.018 * size,
        )  # fmt: skip
        along = {BASE: -0.3, STAR: 0.25}.get(link, 0.5)
        server.scene.add_label(
            f"{node}/name", name, position=along * length * size * np.ones(3),
            anchor="center-center", font_screen_scale=1.7,
        )  # fmt: skip


if __name__ == "__main__":
    picture(Path(sys.argv[1]))
