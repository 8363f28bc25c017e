# SPDX-License-Identifier: Apache-2.0
"""Maps against one pose at a time, against what is proved, and singular poses against
theory.
"""

import io
import sys

import numpy as np
import pytest
from mechanism.closed_chains import FOLDING, ISOTROPIC, random_geometry, random_pose
from models import assembly_of
from scipy.spatial.transform import Rotation
from slow_cases import slow_after

from sst_ros.errors import AssemblyError, InputError, SingularConfiguration
from sst_ros.mechanism import kinematics, virtual_work, workspace
from sst_ros.mechanism.geometry import zyz_angles
from sst_ros.mechanism.nearest_singularity import distance_to_singularity


@pytest.fixture(scope="module")
def isotropic():
    return workspace.workspace(ISOTROPIC, 16, 90)


@pytest.fixture(scope="module")
def folding():
    return workspace.workspace(FOLDING, 16, 90)


def test_measures_are_those_of_the_velocity_analysis():
    rng = np.random.default_rng(0)
    for _ in range(20):
        geometry = random_geometry(rng)
        gamma, rotation = random_pose(rng, geometry)
        at = virtual_work.posture(geometry, gamma, rotation)
        found = workspace.measures(geometry, gamma, rotation)
        np.testing.assert_allclose(found.cond_j, np.linalg.cond(at.j), rtol=1e-9)
        np.testing.assert_allclose(found.det_j2, np.linalg.det(at.j2), rtol=1e-9)
        np.testing.assert_allclose(found.det_j1, np.prod(at.c), rtol=1e-9)
        assert found.edge == found.beta.min()
        assert found.margin == min(found.stroke, found.edge, found.reach)


def test_the_map_is_the_inverse_kinematics(isotropic):
    rng = np.random.default_rng(1)
    for _ in range(30):
        i, j = rng.integers(len(isotropic.s)), rng.integers(len(isotropic.psi))
        rotation = workspace.orientations(isotropic.s[i], isotropic.psi[j])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(
            zyz_angles(rotation)[2], isotropic.psi[j], atol=1e-12
        )
        gamma, _, beta = kinematics.inverse(ISOTROPIC, rotation)
        np.testing.assert_allclose(isotropic.measures.gamma[i, j], gamma, atol=1e-14)
        np.testing.assert_allclose(isotropic.measures.beta[i, j], beta, atol=1e-14)
        described = assembly_of(ISOTROPIC, gamma, rotation)
        inside = np.all((gamma >= 0) & (gamma <= ISOTROPIC.arc))
        assert isotropic.measures.admissible[i, j] == (described.admissible and inside)


def test_the_isotropic_workspace(isotropic):
    """Proved: no singular pose inside.

    known: cond J <= 2.44 and 120 deg of turn at the centre.
    """
    found = isotropic.measures
    assert found.cond_j[found.admissible].max() < 2.45
    assert np.nanmin(isotropic.best_cond_j) >= 1.0
    assert len(workspace.parallel_singularities(isotropic)) == 0
    centre = workspace.over_orientations(ISOTROPIC, [[1.0, 1.0, 1.0]], turns=720)
    np.testing.assert_allclose(np.degrees(centre.turn), 120.0, atol=0.5)
    np.testing.assert_allclose(centre.best_cond_j, 1.0, atol=1e-4)
    # Home: beta is 35.2644 deg, the ends of the stroke are 45 deg away.
    np.testing.assert_allclose(np.degrees(centre.best_margin), 35.2644, atol=1.0)
    assert "parallel: none" in workspace.report_singularities(ISOTROPIC, isotropic)


def test_parallel_singularities_of_the_folding_geometry(folding):
    """v = I, alpha = 210, 75, 75 deg: tan b1 sin a2 + tan b2 sin a3 + tan b3 sin a1 =
    0.
    """
    poses = workspace.parallel_singularities(folding)
    assert len(poses) > 20
    a1, a2, a3 = FOLDING.alpha
    for i in range(len(poses)):
        described = assembly_of(FOLDING, poses.gamma[i], poses.rotation[i])
        assert described.admissible
        assert abs(described.det_j2) < 1e-13
        tangents = np.tan(poses.beta[i])
        assert abs(tangents @ [np.sin(a2), np.sin(a3), np.sin(a1)]) < 1e-11
        with pytest.raises(SingularConfiguration, match="parallel") as caught:
            virtual_work.posture(FOLDING, poses.gamma[i], poses.rotation[i])
        assert abs(caught.value.measure) < 1e-12
    assert "parallel: none" not in workspace.report_singularities(FOLDING, folding)


def test_serial_singularities_lie_on_the_edge():
    poses = workspace.serial_singularities(FOLDING)
    assert len(poses) > 0
    for i in range(len(poses)):
        k, rotation = poses.leg[i], poses.rotation[i]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        t = rotation @ FOLDING.e[k]
        assert np.linalg.norm(np.cross(t, FOLDING.w[k])) < 1e-14
        assert abs(FOLDING.w[k] @ rotation[:, 2]) < 1e-14
        others = [j for j in range(3) if j != k]
        assert np.all(poses.beta[i, others] > 0)
    assert len(workspace.serial_singularities(ISOTROPIC)) == 0


def test_directions_fill_the_triangle():
    rng = np.random.default_rng(3)
    for geometry in (ISOTROPIC, random_geometry(rng)):
        s, faces = workspace.triangle_directions(geometry, 12)
        assert len(s) == 13 * 14 // 2 and len(faces) == 12**2
        assert np.all(s @ geometry.w.T > 0)
        np.testing.assert_allclose(np.linalg.norm(s, axis=1), 1.0, atol=1e-15)
        areas = np.linalg.det(s[faces])
        assert np.all(areas * areas[0] > 0)


@pytest.mark.parametrize("terminal", [True, False])
def test_the_bar_is_for_terminals_only(terminal, monkeypatch):
    stream = io.StringIO()
    stream.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", stream)
    workspace.workspace(ISOTROPIC, 2, 4, progress=True)
    assert ("100 %" in stream.getvalue()) == terminal


def test_the_picture_has_three_maps_a_row(isotropic, folding):
    pytest.importorskip("matplotlib")
    from sst_ros.plot.workspace import plot_workspace

    figure = plot_workspace(isotropic, folding, titles=["isotropic", "general"])
    assert len(figure.axes) == 12  # six pictures, six colour bars


@pytest.mark.slow
def test_no_ray_meets_a_singularity_before_the_nearest():
    """Parallel: rows r_k x t_k that are dependent; serial: t_k on the line of w_k."""
    rng, kinds = np.random.default_rng(6), set()
    while len(kinds) < 2 or rng.random() < 0.9:
        geometry = random_geometry(rng)
        gamma = geometry.arc * rng.uniform(0.2, 0.8, 3)
        try:
            start = kinematics.admissible(geometry, gamma).rotation
        except AssemblyError:
            continue
        found = distance_to_singularity(geometry, gamma)
        kinds.add(found.kind)
        turn = Rotation.from_rotvec(found.distance * found.axis)
        np.testing.assert_allclose(found.rotation, start @ turn.as_matrix(), atol=1e-12)

        def measure(rotation, geometry=geometry):
            angles, _, _ = kinematics.inverse(geometry, rotation)
            r = kinematics.carriage_directions(geometry, angles)
            t = geometry.e @ np.swapaxes(rotation, -1, -2)
            rows = np.cross(r, t)
            return np.linalg.det(rows), np.linalg.norm(
                np.cross(t, geometry.w), axis=-1
            ).min(-1)

        dependent, sine = measure(found.rotation)
        assert abs(dependent if found.kind == "parallel" else sine) < 1e-8
        axes = rng.normal(size=(500, 3))
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        lengths = np.linspace(0.0, 0.99, 100) * found.distance
        rays = Rotation.from_rotvec(
            (axes[:, None] * lengths[:, None]).reshape(-1, 3)
        ).as_matrix()
        dependent, sine = measure(start @ rays)
        assert np.ptp(np.sign(dependent)) == 0.0 and sine.min() > 1e-3


@pytest.mark.parametrize(
    "geometry", slow_after(1, [ISOTROPIC, FOLDING]), ids=["isotropic", "folding"]
)
def test_nearest_to_many_poses_has_the_bits_of_each(geometry):
    around = np.random.default_rng(8).uniform(-0.02, 0.02, (120, 3))
    gamma = np.array([0.264, 0.721, 0.523]) + around
    many = distance_to_singularity(geometry, gamma)
    assert len(many) == 120
    for near, angles in zip(many, gamma, strict=True):
        alone = distance_to_singularity(geometry, angles)
        assert (near.kind, near.leg) == (alone.kind, alone.leg)
        assert near.distance == alone.distance
        assert (near.axis == alone.axis).all()
        assert (near.rotation == alone.rotation).all()
    assert "120" in repr(many)


def test_no_poses_have_no_nearest_singularity():
    assert len(distance_to_singularity(ISOTROPIC, np.empty((0, 3)))) == 0


@pytest.mark.parametrize(
    ("gamma", "error", "said"),
    [
        ([0.8, 0.8], InputError, "three angles .rad., or rows of them"),
        ([[0.8, 0.8]], InputError, "three angles .rad., or rows of them"),
        (np.full((2, 2, 3), 0.8), InputError, "three angles .rad., or rows of them"),
        ([[0.8, 0.8, 0.8], [0.8]], InputError, "gamma = "),
        ([[0.8, 0.8, 0.8], [0.8, 0.8, np.nan]], AssemblyError, "three finite numbers"),
        (
            [[0.8, 0.8, 0.8], [3.0, 3.0, 0.1]],
            AssemblyError,
            r"= \[3\.  3\.  0\.1\]",
        ),
    ],
)
def test_gammas_without_a_nearest_singularity(gamma, error, said):
    with pytest.raises(error, match=said):
        distance_to_singularity(ISOTROPIC, gamma)
