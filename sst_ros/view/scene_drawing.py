# SPDX-License-Identifier: Apache-2.0
"""The manipulator in viser's scene: seven links that rotate about O, the path of E, s, torques."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from viser import ArrowsHandle, ViserServer

from sst_ros.description import robot
from sst_ros.mechanism.geometry import Array, Geometry, quaternion_of
from sst_ros.scene.scene import Scene

PATH_POINTS = 400
_POINT_PERIOD_S = 0.008
_PATH_S = 4.0
_LIFT = np.linspace(1.006, 1.022, PATH_POINTS)[:, None]
"""The path lies a little outside the star, which would hide it; newer parts above older ones."""
_OLD, _NEW = np.array([0.90, 0.86, 0.92]), np.array([0.42, 0.00, 0.42])
ROOT = "/manipulator"
_SIDES = 20  # corners of an arc's cross-section


class SceneDrawing:
    """One scene as drawn, in nodes below ROOT."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        self._server, self._scene, self._geometry = server, scene, Geometry.of(scene)
        self._joints = robot.joints_of(self._geometry)
        self._frames = {}
        for link, drawn in robot.shapes(scene).items():
            self._frames[link] = server.scene.add_frame(f"{ROOT}/{link}", show_axes=False)
            for index, shape in enumerate(drawn):
                add_shape(server, f"{ROOT}/{link}/{index}", shape)
        self._size = size = max(scene.base.radius, scene.star.radius)
        self._add_labels()
        self._points: deque[tuple[float, Array]] = deque(maxlen=PATH_POINTS)
        self._last = -np.inf
        fade = np.linspace(0.0, 1.0, PATH_POINTS)[:, None]
        colours = (1.0 - fade) * _OLD + fade * _NEW
        self._path = server.scene.add_line_segments(
            f"{ROOT}/path",
            np.zeros((PATH_POINTS - 1, 2, 3)),
            np.stack([colours[:-1], colours[1:]], axis=1),
            thickness=0.016 * size,
        )
        outward = scene.star.radius * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.28]])
        self._add_arrow(f"{robot.STAR}/s", outward, robot.STAR_COLOUR, (0.010, 0.028, 0.075))
        self._torques = [
            self._add_arrow(f"torque_{k}", np.zeros((2, 3)), colour, (0.014, 0.040, 0.090))
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
            star = robot.rotations(self._joints[:3], angles)[robot.STAR]
            self._points.append((time, self._scene.star.radius * star[:, 2]))
            while self._points[0][0] < time - _PATH_S:
                self._points.popleft()

    def show(self, angles: Mapping[str, float], torque: Sequence[float]) -> None:
        """Move everything to joint angles [rad], and show torques [N m], shape (3,)."""
        found = robot.rotations(self._joints, angles)
        for link, frame in self._frames.items():
            frame.wxyz = wxyz(found[link])
        end = self._scene.star.radius * found[robot.STAR][:, 2]
        points = np.array([*(point for _, point in self._points), end])[-PATH_POINTS:]
        points = np.concatenate([np.repeat(points[:1], PATH_POINTS - len(points), axis=0), points])
        points *= _LIFT
        self._path.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        # tau_k along w_k, outwards where positive; the largest yet has full length
        self._largest_torque = max(self._largest_torque, *map(abs, torque))
        for arrow, tau, w in zip(self._torques, torque, self._geometry.w, strict=True):
            length = 0.45 * self._size * abs(tau) / self._largest_torque
            visible = length > 0.01 * self._size
            if visible:
                foot = 1.17 * self._scene.base.radius
                ends = np.array([foot * w, (foot + length) * w])
                arrow.points = (ends if tau > 0.0 else ends[::-1]).astype(np.float32)[None]
            arrow.visible = visible

    def _add_arrow(
        self, name: str, ends: Array, colour: ArrayLike, sizes: tuple[float, float, float]
    ) -> ArrowsHandle:
        """Add an arrow between two points; sizes of shaft and head are parts of the largest link's.

        viser takes linear colours for arrows, and sRGB for all else.
        """
        shaft, head, length = (self._size * size for size in sizes)
        linear = np.asarray(colour, dtype=float) ** 2.2
        given: Any = {"shaft_radius": shaft, "head_radius": head, "head_length": length}
        return self._server.scene.add_arrows(f"{ROOT}/{name}", ends[None], linear, **given)

    def _add_labels(self) -> None:
        """Name the vertices P_k of the base triangle, on its outer side, and E."""
        v = self._geometry.v
        outwards = v - v.mean(axis=0)
        outwards /= np.linalg.norm(outwards, axis=1)[:, None]
        points = self._scene.base.radius * (v + 0.13 * outwards)
        end = self._scene.star.radius * np.array([0.0, 0.0, 1.36])
        places = [(f"{robot.BASE}/P{k}", f"P{'₁₂₃'[k - 1]}", at) for k, at in enumerate(points, 1)]
        for name, text, at in (*places, (f"{robot.STAR}/E", "E", end)):
            self._server.scene.add_label(
                f"{ROOT}/{name}", text, position=at, anchor="center-center", font_screen_scale=2.0
            )


def add_shape(server: ViserServer, name: str, shape: robot.Shape) -> None:
    """Add a shape to viser's scene under a name."""
    scene = server.scene
    if isinstance(shape, robot.Ball):
        scene.add_icosphere(
            name, shape.radius, shape.colour, position=shape.centre,
            subdivisions=3 if shape.radius < 0.1 else 20,  # of an edge of the icosahedron
            opacity=shape.opacity if shape.opacity < 1.0 else None,
        )  # fmt: skip
    elif isinstance(shape, robot.Box):
        scene.add_box(name, shape.colour, shape.size, position=shape.centre)
    elif isinstance(shape, robot.Arc):
        turns = 2.0 * np.pi * np.arange(_SIDES + 1) / _SIDES
        outline = np.stack([np.cos(turns), np.sin(turns)], axis=1) * shape.thickness
        mesh = trimesh.creation.revolve(
            outline + np.array([shape.radius, 0.0]), angle=shape.angle, sections=len(shape.points())
        )
        frame = np.stack([shape.begin, np.cross(shape.axis, shape.begin), shape.axis], axis=1)
        scene.add_mesh_simple(name, mesh.vertices @ frame.T, mesh.faces, color=shape.colour)
        for index, end in enumerate(shape.points()[[0, -1]]):
            add_shape(server, f"{name}/{index}", robot.Ball(end, shape.thickness, shape.colour))
    else:
        along = shape.end - shape.begin
        middle, length = (shape.begin + shape.end) / 2.0, float(np.linalg.norm(along))
        turn = wxyz(Rotation.align_vectors(along, [0.0, 0.0, 1.0])[0].as_matrix())
        size = shape.thickness, length
        scene.add_cylinder(name, *size, shape.colour, position=middle, wxyz=turn)


def wxyz(rotation: Array) -> Array:
    """Quaternion (w, x, y, z), as viser takes it, of a rotation matrix."""
    return np.roll(quaternion_of(rotation), 1)
