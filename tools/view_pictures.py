# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the page.

Run `python -m tools.view_pictures`, then docs/mechanism.png or docs/view.webp. The
picture shows the mechanism as built. The frames of the paper have their origins at O;
{1k}, {2k} and {E} are drawn on their links, where they can be distinguished; axes are x
red, y green, z blue. The film shows what `make view` does, of a run in slow motion, so
that it is as smooth as the motion is, however slowly a machine without graphics draws.
"""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
from datetime import date
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from sst_ros.description.robot import (
    ACTUATED_LINKS,
    BASE,
    INTERMEDIATE,
    LEG_NUMBERS,
    STAR_LINK,
)
from sst_ros.errors import SstError
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from sst_ros.view.page import SceneDrawing
from sst_ros.view.server import PageServer
from sst_ros.view.source import ViewState, run_simulator
from tools.browser import Browser, browse

SCENE = "example2"
SIZE, WIDTH = (1440, 1200), 1080
_PORT = 18400
_ALONG = np.radians(58.0)
"""Where {1k} is drawn on its bar, from the carriage towards the motor."""
FILMED, FILM_SIZE, FILM_WIDTH = "swing", (1040, 700), 900
FRAMES, RATE = 75, 25
"""Pictures, and how many make a second of the run and of the film."""
SLOW = 0.01
"""Time of the run per time."""
_QUALITY = 55


def picture(path: Path) -> None:
    """Write the picture as PNG."""
    scene = load(SCENE)
    server = PageServer(port=_PORT)
    try:
        _build(server, scene)
        with browse() as page:
            page.open(server.url, SIZE)
            page.hide(
                ".mantine-Notification-root, .mantine-Paper-root,"
                " .mantine-ActionIcon-root"
            )
            for _ in range(10):
                page.drawn()
            taken = Image.open(io.BytesIO(page.picture())).convert("RGB")
    finally:
        server.stop()
    _shrink(taken, WIDTH).save(path, optimize=True)


def _shrink(taken: Image.Image, width: int) -> Image.Image:
    size = (width, width * taken.height // taken.width)
    return taken.resize(size, Image.Resampling.LANCZOS)


def _build(server: PageServer, scene: Scene) -> None:
    """Draw frames and scene in its initial pose, without the globe that hides O."""
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.set_up_direction("+z")
    drawing = SceneDrawing(server, scene)
    state = Simulation(scene).state
    at = state.joints
    shown = ViewState(None, at.gamma, at.mu, at.beta, at.gamma_dot, (0.0, 0.0, 0.0))
    drawing.show(shown.angles, shown.torque)
    for name in (f"{BASE}/0", f"{STAR_LINK}/s", f"{STAR_LINK}/E"):
        server.scene.remove_by_name(f"/manipulator/{name}")
    size = max(scene.base.radius, scene.star.radius)
    _add_frames(server, scene, size)
    middle = Geometry.of(scene).v.sum(axis=0)
    middle /= np.linalg.norm(middle)
    camera = server.initial_camera
    camera.fov = np.radians(32.0)
    camera.look_at = 0.32 * size * middle
    camera.position = size * (3.4 * middle + np.array([0.25, -1.1, 1.1]))


LABELS = {
    BASE: (-0.3, -0.3, -0.3),
    STAR_LINK: (0.45, 0.0, 0.8),
    ACTUATED_LINKS[0]: (0.65, 0.7, 0.0),
    ACTUATED_LINKS[1]: (-0.3, -0.7, 0.3),
}
"""Places of names that would lie on an axis of their frame, in lengths of its axes."""


def _add_frames(server: PageServer, scene: Scene, size: float) -> None:
    thick, base, star = 0.02 * scene.base.radius, scene.base.radius, scene.star.radius
    end = np.array([0.0, 0.0, star])
    bar = 1.04 * (base + 1.5 * thick) * np.array([np.cos(_ALONG), 0.0, np.sin(_ALONG)])
    places = {BASE: ("{B}", np.zeros(3), 0.42), STAR_LINK: ("{E}", 1.05 * end, 0.24)}
    for k in LEG_NUMBERS:
        places[ACTUATED_LINKS[k - 1]] = (f"{{1{k}}}", bar, 0.15)
        places[INTERMEDIATE[k - 1]] = (
            f"{{2{k}}}",
            1.07 * star * np.array([1.0, 0.0, 0.0]),
            0.15,
        )
    for link, (name, position, length) in places.items():
        node = f"/manipulator/{link}/axes"
        server.scene.add_frame(
            node, axes_length=length * size, axes_radius=0.010 * size,
            position=position, origin_radius=0.018 * size,
        )  # fmt: skip
        beside = np.array(LABELS.get(link, (0.5, 0.5, 0.5)))
        server.scene.add_label(
            f"{node}/name", name, position=length * size * beside,
            anchor="center-center", font_screen_scale=1.7,
        )  # fmt: skip


def film(path: Path) -> None:
    """Write the film as an animated WebP.

    Raises:
        SstError: there is no browser, or the page does not do what it should.

    """
    command = [sys.executable, "-m", "sst_ros", "view"]
    with (
        run_simulator(FILMED, SLOW),
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                raise SstError("`view` printed no address")
            with browse() as page:
                page.open(found.group(), FILM_SIZE)
                taken = [
                    Image.open(io.BytesIO(png)).convert("RGB")
                    for png in _pictures(page)
                ]
        finally:
            process.send_signal(signal.SIGINT)
    first, *others = (_shrink(picture, FILM_WIDTH) for picture in taken)
    first.save(path, save_all=True, append_images=others, duration=1000 // RATE, loop=0,
               quality=_QUALITY, method=6)  # fmt: skip
    print(
        f"{path}: {len(taken)} frames, {path.stat().st_size / 1e6:.2f} MB,"
        f" {date.today()}"
    )


def _pictures(page: Browser) -> list[bytes]:
    page.until(lambda: page.time() is not None, "time of a run")
    page.hide(".mantine-Notification-root")
    begin, taken = page.time() or 0.0, []
    for frame in range(FRAMES):
        due = begin + (frame + 1) / RATE - 1e-9
        page.until(partial(_has_reached, page, due), f"time {due:.2f} s")
        page.drawn()
        taken.append(page.picture())
    return taken


def _has_reached(page: Browser, due: float) -> bool:
    return (page.time() or 0.0) >= due


if __name__ == "__main__":
    (film if sys.argv[1].endswith(".webp") else picture)(Path(sys.argv[1]))
