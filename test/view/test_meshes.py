# SPDX-License-Identifier: Apache-2.0
"""Meshes of the shapes against the volumes of tubes, balls and boxes."""

import numpy as np
import pytest

from sst_ros.description.shapes import STEP, Ball, Box, Tube, arc, end_point, shapes
from sst_ros.description.tree import STAR
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import load, names
from sst_ros.view.meshes import ROUND, meshes

RED = (1.0, 0.0, 0.0)
CIRCLE = ROUND * np.sin(2.0 * np.pi / ROUND) / (2.0 * np.pi)
"""Area of the polygon that stands for a circle, over the circle's."""


def volume(shape):
    """Gauss's theorem: positive only where all faces look outwards."""
    (mesh,) = meshes([shape])
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


def test_a_straight_tube():
    points = np.array([[0.1, 0.2, 0.3], [0.1, 1.2, 1.3]])
    expected = CIRCLE * np.pi * 0.05**2 * np.sqrt(2.0)
    assert volume(Tube(points, 0.05, RED)) == pytest.approx(expected, rel=1e-12)


def test_a_tube_along_an_arc():
    """Pappus: the area times the way of its centre."""
    points = arc(np.eye(3)[1], np.eye(3)[0], 2.0, 0.4)
    expected = CIRCLE * np.pi * 0.02**2 * 0.4 * 2.0
    assert volume(Tube(points, 0.02, RED)) == pytest.approx(expected, rel=STEP**2)


def test_a_ball_and_a_box():
    centre = np.array([0.3, -0.1, 0.2])
    assert volume(Ball(centre, 0.5, RED)) == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=3e-3)
    size = np.array([0.1, 0.2, 0.3])
    assert volume(Box(centre, size, RED)) == pytest.approx(0.006, rel=1e-12)


def test_an_arc_begins_ends_and_stays_on_its_sphere():
    begin, axis = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    points = arc(begin, axis, 1.234, 0.35)
    assert points[0] == pytest.approx(0.35 * begin)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.35)
    assert np.arccos(points[0] @ points[-1] / 0.35**2) == pytest.approx(1.234)
    assert points[-1] @ np.cross(axis, begin) > 0.0


@pytest.mark.parametrize("name", names())
def test_every_scene_is_drawn(name):
    scene = load(name)
    drawn = shapes(scene)
    everything = [mesh for link in drawn.values() for mesh in meshes(link)]
    assert len(drawn) == 8
    for mesh in everything:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.max() == len(mesh.vertices) - 1


@pytest.mark.parametrize("name", ["example2", "general"])
def test_the_star_s_arcs_lie_across_e_and_begin_at_the_end_point(name):
    scene = load(name)
    geometry = Geometry.of(scene)
    arcs = [shape.points for shape in shapes(scene)[STAR] if isinstance(shape, Tube)][:3]
    for points, e in zip(arcs, geometry.e, strict=True):
        assert points[0] == pytest.approx(end_point(scene, np.eye(3)))
        assert points @ e == pytest.approx(0.0, abs=1e-15)
