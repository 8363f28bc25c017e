# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of the page.

Run `python -m tools.view_pictures`, then docs/mechanism.png, docs/sensors.png or
docs/view.webp. The first picture shows the mechanism as built. The frames of the paper
have their origins at O; {1k}, {2k} and {E} are drawn on their links, where they can be
distinguished; axes are x red, y green, z blue. The film shows what `make view` does, of
a run in slow motion, so that it is as smooth as the motion is, however slowly a machine
without graphics draws.
The picture of the sensors has what a recorded run of the nodes has in ~/imu and
~/reaction at one instant, in the frames that the messages name.
"""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from rosbags.highlevel import AnyReader

from benchmark.nodes import Process, own_domain, start_simulator
from sst_ros.description.robot import (
    ACTUATED_LINKS,
    BASE,
    INTERMEDIATE,
    LEG_NUMBERS,
    STAR_LINK,
    joints_of,
    rotations,
)
from sst_ros.errors import SstError
from sst_ros.mechanism.geometry import Array, Geometry, rotation_matrix
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene, load
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, nanoseconds
from sst_ros.view.page import ROOT, SceneDrawing
from sst_ros.view.server import PageServer
from sst_ros.view.source import run_simulator
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


SENSED, SENSED_S = "gravity_payload", 0.3
"""Scene of the run with sensors, and the instant that is drawn [s]."""
IMU_POSITION = (0.268, 0.0, 0.297)  # on the arm of leg 1
REACTION = "prismatic_1"
TOPICS = ("/joint_states", "/sst_simulator/imu", "/sst_simulator/reaction")
ARROWS = {"specific force": (0.2, 0.2, 0.2), "reaction": (0.8, 0.2, 0.2)}
"""Colour of each arrow; the longest is half as long as the arms."""


def picture(path: Path) -> None:
    """Write the picture of the mechanism as PNG."""
    scene = load(SCENE)
    server = PageServer(port=_PORT)
    try:
        at = Simulation(scene).state.joints
        _draw(
            server, scene, dict(zip(JOINTS, (*at.gamma, *at.mu, *at.beta), strict=True))
        )
        _add_frames(server, scene, max(scene.base.radius, scene.star.radius))
        _take(server, path)
    finally:
        server.stop()


def sensors(path: Path) -> None:
    """Write the picture of the sensors as PNG."""
    scene = load(SENSED)
    with tempfile.TemporaryDirectory() as folder:
        sample = _record(Path(folder) / "bag")
    server = PageServer(port=_PORT)
    try:
        angles = dict(zip(sample.state.name, sample.state.position, strict=True))
        _draw(server, scene, angles, aside=3.2)
        _add_sensors(server, scene, angles, sample)
        _take(server, path)
    finally:
        server.stop()


class _Sample(NamedTuple):
    """Messages of one instant."""

    state: Any  # sensor_msgs/JointState
    imu: Any  # sensor_msgs/Imu
    reaction: Any  # geometry_msgs/WrenchStamped


def _record(bag: Path) -> _Sample:
    """Record a run of the nodes; return what its bag has at the instant."""
    topics = f"[{','.join(TOPICS)}]"
    with own_domain():
        recorder = Process("recorder", output=bag, topics=topics)
        simulator = start_simulator(
            scene=SENSED, duration=2 * SENSED_S, wait_for_subscribers=topics,
            imu=True, imu_position=list(IMU_POSITION), reaction=REACTION,
        )  # fmt: skip
        simulator.wait()
        status, output = recorder.end()
    if status != 0:
        raise SstError(f"the recorder ended with status {status}: {output}")
    with AnyReader([bag]) as reader:
        messages: dict[str, dict[int, Any]] = {topic: {} for topic in TOPICS}
        for connection, _, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp
            messages[connection.topic][nanoseconds(stamp)] = message
    states, imus, reactions = (messages[topic] for topic in TOPICS)
    due = min(imus) + round(SENSED_S * NANOSECONDS)
    return _Sample(states[due], imus[due], reactions[due])


def _take(server: PageServer, path: Path) -> None:
    """Take a picture of the scene alone."""
    with browse() as page:
        page.open(server.url, SIZE)
        page.hide(
            ".mantine-Notification-root, .mantine-Paper-root, .mantine-ActionIcon-root"
        )
        for _ in range(10):
            page.drawn()
        taken = Image.open(io.BytesIO(page.picture())).convert("RGB")
    _shrink(taken, WIDTH).save(path, optimize=True)


def _shrink(taken: Image.Image, width: int) -> Image.Image:
    size = (width, width * taken.height // taken.width)
    return taken.resize(size, Image.Resampling.LANCZOS)


def _draw(
    server: PageServer, scene: Scene, angles: Mapping[str, float], aside: float = 0.0
) -> None:
    """Draw a scene at joint angles [rad], without the globe that hides O.

    It is seen from over the middle of the base, and from as many radii aside.
    """
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.set_up_direction("+z")
    SceneDrawing(server, scene).show(angles, (0.0, 0.0, 0.0))
    for name in (f"{BASE}/0", f"{STAR_LINK}/s", f"{STAR_LINK}/E"):
        server.scene.remove_by_name(f"{ROOT}/{name}")
    size = max(scene.base.radius, scene.star.radius)
    middle = Geometry.of(scene).v.sum(axis=0)
    middle /= np.linalg.norm(middle)
    camera = server.initial_camera
    camera.fov = np.radians(32.0)
    camera.look_at = 0.32 * size * middle
    side = np.cross([0.0, 0.0, 1.0], middle)
    direction = 3.4 * middle + np.array([0.25, -1.1, 1.1]) + aside * side
    camera.position = size * (1.0 - 0.03 * aside) * direction


def _add_sensors(
    server: PageServer, scene: Scene, angles: Mapping[str, float], sample: _Sample
) -> None:
    """Draw the frame of the IMU, what it measures, and the force of a joint."""
    size = max(scene.base.radius, scene.star.radius)
    links = rotations(joints_of(Geometry.of(scene)), angles)
    position = links[STAR_LINK] @ np.array(IMU_POSITION)
    turned = sample.imu.orientation
    measured = rotation_matrix((turned.x, turned.y, turned.z, turned.w))
    frame = f"{ROOT}/{sample.imu.header.frame_id}"
    server.scene.add_frame(
        frame, axes_length=0.2 * size, axes_radius=0.010 * size, position=position,
        wxyz=(turned.w, turned.x, turned.y, turned.z), origin_radius=0.018 * size,
    )  # fmt: skip
    name = sample.imu.header.frame_id
    _add_text(server, frame, f"{name}: ~/imu", np.array([0.0, 0.3 * size, 0.0]))
    force = measured @ _numbers(sample.imu.linear_acceleration)
    _add_arrow(server, "specific force", position, force, size, "m/s²")
    header = sample.reaction.header
    force = links[header.frame_id] @ _numbers(sample.reaction.wrench.force)
    _add_arrow(server, "reaction", np.zeros(3), force, size, f"N, {REACTION}")


def _numbers(vector: Any) -> Array:
    return np.array([vector.x, vector.y, vector.z])


def _add_arrow(
    server: PageServer, name: str, foot: Array, vector: Array, size: float, unit: str
) -> None:
    """Draw a vector as an arrow of one length, with its magnitude beside its tip."""
    magnitude = float(np.linalg.norm(vector))
    tip = foot + 0.5 * size * vector / magnitude
    sizes: Any = {
        "shaft_radius": 0.012 * size,
        "head_radius": 0.035 * size,
        "head_length": 0.08 * size,
    }
    node = f"{ROOT}/{name.replace(' ', '_')}"
    ends = np.array([[foot, tip]], dtype=np.float32)
    server.scene.add_arrows(node, ends, np.array(ARROWS[name]) ** 2.2, **sizes)
    beyond = foot + 0.58 * size * vector / magnitude
    _add_text(server, node, f"{name}, {magnitude:.2f} {unit}", beyond)


def _add_text(server: PageServer, node: str, text: str, position: Array) -> None:
    server.scene.add_label(
        f"{node}/name", text, position=position,
        anchor="center-center", font_screen_scale=1.7,
    )  # fmt: skip


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
        node = f"{ROOT}/{link}/axes"
        server.scene.add_frame(
            node, axes_length=length * size, axes_radius=0.010 * size,
            position=position, origin_radius=0.018 * size,
        )  # fmt: skip
        beside = np.array(LABELS.get(link, (0.5, 0.5, 0.5)))
        _add_text(server, node, name, length * size * beside)


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


PICTURES = {"mechanism": picture, "sensors": sensors, "view": film}
"""What draws each picture, by the name of its file."""


if __name__ == "__main__":
    file = Path(sys.argv[1])
    PICTURES[file.stem](file)
