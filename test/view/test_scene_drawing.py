# SPDX-License-Identifier: Apache-2.0
"""What is sent to the browser is where the manipulator is, and as large."""

import numpy as np
import pytest

pytest.importorskip("viser", reason="needs viser: pip install .[view]")

import trimesh

from sst_ros.description.robot import BASE, STAR_LINK, Arc, Ball, Box, Rod, shapes
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation
from sst_ros.view.page import ROOT, SceneDrawing, add_shape
from sst_ros.view.source import ViewState

RED = (1.0, 0.0, 0.0)


def node(server, name):
    return server.scene._handle_from_node_name[name]


def turned(handle):
    """Rotation matrix of a node in its parent."""
    w, x, y, z = handle.wxyz
    return rotation_matrix([x, y, z, w])


def test_an_arc_is_a_tube_about_its_circle(server):
    """Pappus: the circumference of the cross-section times the length of its centre's
    path.
    """
    begin, axis = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    add_shape(server, "/arc", Arc(begin, axis, 2.0, 0.4, 0.02, RED))
    drawn = node(server, "/arc")
    mesh = trimesh.Trimesh(drawn.vertices, drawn.faces, process=False)
    assert mesh.area == pytest.approx(2.0 * np.pi * 0.02 * 0.4 * 2.0, rel=0.01)
    circle = 0.4 * drawn.vertices / np.linalg.norm(drawn.vertices, axis=1)[:, None]
    outwards = mesh.face_normals * (
        mesh.triangles_center - circle[mesh.faces].mean(axis=1)
    )
    beside = np.abs(outwards.sum(axis=1)) > 1e-3
    assert (outwards.sum(axis=1)[beside] > 0.0).all()
    along = drawn.vertices @ np.cross(axis, begin)
    assert np.ptp(np.linalg.norm(drawn.vertices, axis=1)) == pytest.approx(
        0.04, rel=0.05
    )
    assert along.max() == pytest.approx(0.42, rel=0.01)
    assert np.arctan2(along, drawn.vertices @ begin).max() == pytest.approx(
        2.0, rel=1e-5
    )


def test_a_rod_a_ball_and_a_box(server):
    begin, end = np.array([0.1, 0.2, 0.3]), np.array([0.1, 1.2, 1.3])
    add_shape(server, "/rod", Rod(begin, end, 0.05, RED))
    rod = node(server, "/rod")
    half = turned(rod) @ [0.0, 0.0, 0.5 * rod.height]
    assert rod.position + half == pytest.approx(
        end
    ) and rod.position - half == pytest.approx(begin)
    add_shape(server, "/ball", Ball(begin, 0.5, RED))
    ball = node(server, "/ball")
    assert (ball.radius, tuple(ball.position)) == (0.5, tuple(begin))
    add_shape(server, "/box", Box(begin, np.array([0.1, 0.2, 0.3]), RED))
    box = node(server, "/box")
    assert box.dimensions == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize("name", ["example2", "general", "gravity_payload"])
def test_links_are_where_the_simulation_has_them(server, name):
    scene = load(name)
    drawing = SceneDrawing(server, scene)
    simulation = Simulation(scene)
    state = simulation.step((0.3, -0.2, 0.1), 5_000_000)
    at = state.joints
    shown = ViewState(0.005, at.gamma, at.mu, at.beta, at.gamma_dot, state.torque)
    drawing.show(shown.angles, shown.torque)
    star = node(server, f"/manipulator/{STAR_LINK}")
    assert turned(star) == pytest.approx(rotation_matrix(state.quaternion), abs=1e-12)
    for link, drawn in shapes(scene).items():
        for index in range(len(drawn)):
            assert node(server, f"/manipulator/{link}/{index}") is not None
    server.scene.remove_by_name(ROOT)


def test_labels_are_beside_their_vertices(server):
    scene = load("example2")
    SceneDrawing(server, scene)
    vertices = scene.base.radius * Geometry.of(scene).v
    for k in range(3):
        label = node(server, f"/manipulator/{BASE}/P{k + 1}")
        distances = np.linalg.norm(label.position - vertices, axis=1)
        assert distances[k] < 0.15 * scene.base.radius and distances.argmin() == k
    server.scene.remove_by_name(ROOT)
