# SPDX-License-Identifier: Apache-2.0
"""Triangles of the shapes that a link is drawn with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sst_ros.description.shapes import Ball, Box, Colour, Shape, Tube
from sst_ros.mechanism.geometry import Array

ROUND = 20
"""Corners of a circle."""


class Mesh(NamedTuple):
    """Triangles of one colour; vertices (n, 3) [m], faces (m, 3) counter-clockwise from outside."""

    vertices: Array
    faces: NDArray[np.uint32]
    colour: Colour
    opacity: float


def meshes(shapes: Iterable[Shape]) -> Iterator[Mesh]:
    """Yield one mesh for each colour of a link's shapes."""
    groups: dict[tuple[Colour, float], list[tuple[Array, Array]]] = {}
    for shape in shapes:
        opacity = shape.opacity if isinstance(shape, Ball) else 1.0
        groups.setdefault((shape.colour, opacity), []).append(_triangles(shape))
    for (colour, opacity), parts in groups.items():
        counts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
        vertices = np.concatenate([vertices for vertices, _ in parts])
        faces = np.concatenate([part[1] + n for part, n in zip(parts, counts, strict=True)])
        yield Mesh(vertices, faces.astype(np.uint32), colour, opacity)


def _triangles(shape: Shape) -> tuple[Array, Array]:
    if isinstance(shape, Tube):
        return _tube(shape.points, shape.radius)
    if isinstance(shape, Ball):
        return _ball(shape.centre, shape.radius)
    return _box(shape)


def _tube(points: Array, radius: float) -> tuple[Array, Array]:
    """Rings around the points, across the mean direction of the chords, and a lid at both ends."""
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1)[:, None]
    along = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    along /= np.linalg.norm(along, axis=1)[:, None]
    # An axis that no chord of a plane arc is parallel to: that of its plane.
    normal = np.cross(steps[0], steps[-1])
    if np.linalg.norm(normal) < 1e-9:
        normal = np.cross(steps[0], np.eye(3)[np.argmin(np.abs(steps[0]))])
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, along)
    angles = 2.0 * np.pi * np.arange(ROUND) / ROUND
    circle = (
        np.cos(angles)[None, :, None] * across[:, None]
        + np.sin(angles)[None, :, None] * (np.cross(along, across)[:, None])
    )
    rings = points[:, None] + radius * circle
    faces = _rings(len(points), ROUND)
    # Lids have vertices of their own, for sharp edges.
    size = len(points) * ROUND
    vertices = [rings.reshape(-1, 3)]
    for ring, order in ((rings[0], -1), (rings[-1], 1)):
        vertices.append(ring)
        fan = np.arange(1, ROUND - 1)
        faces = np.concatenate(
            [faces, size + np.stack([0 * fan, fan, fan + 1], axis=1)[:, ::order]]
        )
        size += ROUND
    return np.concatenate(vertices), faces


def _ball(centre: Array, radius: float) -> tuple[Array, Array]:
    rows = ROUND if radius < 0.1 else 3 * ROUND
    polar, around = (
        np.linspace(np.pi, 0.0, rows + 1),
        2.0 * np.pi * np.arange(2 * rows) / (2 * rows),
    )
    grid = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones_like(around)),
        ],
        axis=-1,
    )
    return centre + radius * grid.reshape(-1, 3), _rings(rows + 1, 2 * rows)


def _box(box: Box) -> tuple[Array, Array]:
    vertices: list[Array] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], side * np.eye(3)[(axis + 2) % 3]
            corners = side * np.eye(3)[axis] + np.array([-u - v, u - v, u + v, -u + v])
            start = 4 * len(vertices)
            vertices.append(box.centre + 0.5 * box.size * corners)
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return np.concatenate(vertices), np.array(faces)


def _rings(rows: int, columns: int) -> Array:
    """Faces between rings of equally many vertices, each closed."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    return np.concatenate(
        [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    )
