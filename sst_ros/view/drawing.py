# SPDX-License-Identifier: Apache-2.0
"""The manipulator in viser's scene: seven links that turn about O, the path of E, s, torques."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike
from viser import ViserServer

from sst_ros.description.shapes import LEG_COLOURS, STAR_COLOUR, end_point, shapes
from sst_ros.description.tree import STAR, rotations, tree
from sst_ros.mechanism.frames import quaternion_of
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.view.meshes import meshes
from sst_ros.view.source import Sample

TRACE = 400
"""Points of the path that are kept."""
_GAP = 0.008
"""Least time between two of them [s]."""
_KEPT_S = 4.0
"""How long a point is kept."""
_LIFT = np.linspace(1.006, 1.022, TRACE)[:, None]
"""The path lies a little above the star, or the star would hide it, and over what is older."""
_OLD, _NEW = np.array([0.90, 0.86, 0.92]), np.array([0.42, 0.00, 0.42])
"""Its colours."""
_ROOT = "/manipulator"


class Drawing:
    """One scene as drawn; `remove` takes it off the page."""

    def __init__(self, server: ViserServer, scene: Scene) -> None:
        self._scene, self._geometry = scene, Geometry.of(scene)
        self._joints = tree(self._geometry)
        self._server = server
        self._frames = {}
        for link, drawn in shapes(scene).items():
            self._frames[link] = server.scene.add_frame(f"{_ROOT}/{link}", show_axes=False)
            for index, mesh in enumerate(meshes(drawn)):
                server.scene.add_mesh_simple(
                    f"{_ROOT}/{link}/{index}",
                    mesh.vertices,
                    mesh.faces,
                    color=mesh.colour,
                    opacity=mesh.opacity if mesh.opacity < 1.0 else None,
                    cast_shadow=False,
                    receive_shadow=False,
                )
        self._size = size = max(scene.base.radius, scene.star.radius)
        self._labels()
        self._trace: deque[tuple[float, Array]] = deque(maxlen=TRACE)
        self._last = -np.inf
        fade = np.linspace(0.0, 1.0, TRACE)[:, None]
        colours = (1.0 - fade) * _OLD + fade * _NEW
        self._path = server.scene.add_line_segments(
            f"{_ROOT}/path",
            np.zeros((TRACE - 1, 2, 3)),
            np.stack([colours[:-1], colours[1:]], axis=1),
            thickness=0.016 * size,
        )
        radius = scene.star.radius
        server.scene.add_arrows(
            f"{_ROOT}/{STAR}/s",
            np.array([[[0.0, 0.0, radius], [0.0, 0.0, 1.28 * radius]]]),
            _linear(STAR_COLOUR),
            shaft_radius=0.010 * size,
            head_radius=0.028 * size,
            head_length=0.075 * size,
        )
        self._torques = [
            server.scene.add_arrows(
                f"{_ROOT}/torque_{k + 1}",
                np.zeros((1, 2, 3)),
                _linear(colour),
                shaft_radius=0.014 * size,
                head_radius=0.040 * size,
                head_length=0.090 * size,
                visible=False,
            )
            for k, colour in enumerate(LEG_COLOURS)
        ]
        self._full = 1.0

    def remove(self) -> None:
        """Take it off the page."""
        self._server.scene.remove_by_name(_ROOT)

    def forget(self) -> None:
        """Begin a new path."""
        self._trace.clear()
        self._last = -np.inf

    def follow(self, sample: Sample) -> None:
        """Add E at a sample to the path; a time that goes back begins a new one."""
        if sample.time is None or sample.time < self._last:
            self.forget()
        if sample.time is None:
            return
        if sample.time - self._last >= _GAP:
            self._last = sample.time
            self._trace.append((sample.time, end_point(self._scene, self._star(sample))))
            while self._trace[0][0] < sample.time - _KEPT_S:
                self._trace.popleft()

    def show(self, sample: Sample) -> None:
        """Turn everything to a sample."""
        found = rotations(self._joints, _angles(sample))
        for link, frame in self._frames.items():
            x, y, z, w = quaternion_of(found[link])
            frame.wxyz = np.array([w, x, y, z])
        end = end_point(self._scene, found[STAR])
        points = np.array([*(point for _, point in self._trace), end])[-TRACE:]
        points = np.concatenate([np.repeat(points[:1], TRACE - len(points), axis=0), points])
        points *= _LIFT
        self._path.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
        self._show_torques(np.array(sample.torque))

    def _show_torques(self, torques: Array) -> None:
        """Draw tau_k along w_k, out of the motor where positive; the largest so far is longest."""
        self._full = max(self._full, float(np.abs(torques).max()))
        for arrow, torque, w in zip(self._torques, torques, self._geometry.w, strict=True):
            reach = 0.45 * self._size * abs(float(torque)) / self._full
            visible = reach > 0.01 * self._size
            if visible:
                foot = 1.17 * self._scene.base.radius
                ends = np.array([foot * w, (foot + reach) * w])
                arrow.points = (ends if torque > 0.0 else ends[::-1]).astype(np.float32)[None]
            if visible != arrow.visible:
                arrow.visible = visible

    def _star(self, sample: Sample) -> Array:
        return rotations(self._joints[:3], _angles(sample))[STAR]

    def _labels(self) -> None:
        """Name P_k, off the motors, and E."""
        outwards = self._geometry.v - 0.35 * self._geometry.v.mean(axis=0)
        places = {f"base/P{k + 1}": (f"P{'₁₂₃'[k]}", outwards[k]) for k in range(3)}
        places[f"{STAR}/E"] = ("E", np.array([0.0, 0.0, 1.16]))
        for name, (text, where) in places.items():
            self._server.scene.add_label(
                f"{_ROOT}/{name}", text, position=1.17 * self._size * where, anchor="center-center"
            )


def _angles(sample: Sample) -> dict[str, float]:
    values = (*sample.gamma, *sample.mu, *sample.beta)
    return dict(zip(JOINTS, values, strict=True))


def _linear(colours: ArrayLike) -> Array:
    """Colours as arrows want them: viser takes theirs for linear, those of meshes for sRGB."""
    return np.asarray(np.asarray(colours, dtype=float) ** 2.2)
