# SPDX-License-Identifier: Apache-2.0
"""Shapes of the links: where arcs run, and what every scene is drawn with."""

import numpy as np
import pytest

from sst_ros.description.tree import STAR, Arc, Ball, Box, end_point, shapes
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import load, names


def test_an_arc_begins_ends_and_stays_on_its_sphere():
    begin, axis = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    points = Arc(begin, axis, 1.234, 0.35, 0.01, (1.0, 0.0, 0.0)).points()
    assert points[0] == pytest.approx(0.35 * begin)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.35)
    assert np.arccos(points[0] @ points[-1] / 0.35**2) == pytest.approx(1.234)
    assert points[-1] @ np.cross(axis, begin) > 0.0


@pytest.mark.parametrize("name", names())
def test_every_scene_is_drawn(name):
    drawn = shapes(load(name))
    assert len(drawn) == 8
    for shape in (shape for link in drawn.values() for shape in link):
        size = shape.size.min() if isinstance(shape, Box) else getattr(shape, "radius", 1.0)
        assert size > 0.0 and getattr(shape, "thickness", 1.0) > 0.0
        ends = (shape.centre,) if isinstance(shape, Ball | Box) else ()
        assert all(np.isfinite(end).all() for end in ends)


@pytest.mark.parametrize("name", ["example2_heavy", "general"])
def test_the_star_s_arcs_are_perpendicular_to_e_and_begin_at_the_end_point(name):
    scene = load(name)
    geometry = Geometry.of(scene)
    arcs = [shape.points() for shape in shapes(scene)[STAR] if isinstance(shape, Arc)]
    for points, e in zip(arcs, geometry.e, strict=True):
        assert points[0] == pytest.approx(end_point(scene, np.eye(3)))
        assert points @ e == pytest.approx(0.0, abs=1e-15)
