# SPDX-License-Identifier: Apache-2.0
"""Assemblies against the loop closure itself, against symmetry and against plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from models import COUNT, FAST, sample_of, samples
from scipy.spatial.transform import Rotation

from sst_ros.errors import AmbiguousAssembly, AssemblyError, NoAdmissibleAssembly
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Geometry

ISOTROPIC = Geometry.build(np.eye(3), np.radians([120.0] * 3))
HOME = np.full(3, np.pi / 4)
# Positions lose digits like 1 / det J2, which is above 0.05 on the samples.
POSITION = 1e-12


def turned(angle, axis, vector):
    return Rotation.from_rotvec(angle * np.array(axis)).as_matrix() @ vector


def closure(geometry, gamma, rotation):
    """r_k . R e_k, with r_k by turning v_k about w_k."""
    r = [turned(*leg) for leg in zip(gamma, geometry.w, geometry.v, strict=True)]
    return np.array([r_k @ rotation @ e for r_k, e in zip(r, geometry.e, strict=True)])


def gammas(count, seed=0):
    return np.random.default_rng(seed).uniform(0.02, np.pi / 2 - 0.02, (count, 3))


def random_geometries(count, seed):
    rng = np.random.default_rng(seed)
    while count:
        sample = sample_of(rng.uniform(-1.0, 1.0, COUNT))
        if sample is not None:
            count -= 1
            yield sample.geometry, rng.uniform(0.1, 0.9, 3) * sample.geometry.arc


@FAST
@given(samples())
def test_assemblies_close_the_loops_in_pairs_of_proper_rotations(sample):
    found = kinematics.direct(sample.geometry, sample.gamma)
    assert 2 <= len(found) <= 8
    assert len(found) % 2 == 0
    for assembly in found:
        rotation = assembly.rotation
        # 1e-14 is what is promised; turning v_k by SciPy adds the rounding of its products.
        assert np.abs(closure(sample.geometry, sample.gamma, rotation)).max() <= 1.2e-14
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) > 0.0
        twin = rotation @ np.diag([-1.0, -1.0, 1.0])
        assert min(np.abs(other.rotation - twin).max() for other in found) < 1e-13


def test_home_of_the_isotropic_design():
    home = kinematics.admissible(ISOTROPIC, HOME)
    np.testing.assert_allclose(np.degrees(home.mu), 90.0, atol=1e-12)
    beta = np.degrees(np.arcsin(1.0 / np.sqrt(3.0)))
    assert beta == pytest.approx(35.2644, abs=1e-4)
    np.testing.assert_allclose(np.degrees(home.beta), beta, atol=1e-12)
    np.testing.assert_allclose(home.rotation[:, 2], np.full(3, 3.0**-0.5), atol=1e-14)


def test_at_home_j_is_a_permutation():
    j = np.abs(virtual_work.posture(ISOTROPIC, HOME).j)
    np.testing.assert_allclose(np.sort(j, axis=0), [[0] * 3, [0] * 3, [1] * 3], atol=1e-14)
    np.testing.assert_allclose(np.sort(j, axis=1), [[0, 0, 1]] * 3, atol=1e-14)


def has_fermat_point(gamma):
    """All angles of the spherical triangle r1 r2 r3 are below 120 deg."""
    r = kinematics.carriage_directions(ISOTROPIC, gamma)
    for k in range(3):
        one, two = np.cross(r[k], r[k - 1]), np.cross(r[k], r[k - 2])
        angle = np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)
        if angle >= np.radians(120.0):
            return False
    return True


def is_admissible(gamma):
    try:
        kinematics.admissible(ISOTROPIC, gamma)
    except NoAdmissibleAssembly:
        return False
    return True


def test_isotropic_pose_exists_iff_the_carriages_have_a_fermat_point():
    sweep = gammas(400, seed=5)
    answers = [is_admissible(gamma) for gamma in sweep]
    assert answers == [has_fermat_point(gamma) for gamma in sweep]
    # A quarter of the cube; sqrt(0.25 0.75 / 400) = 0.022, so 0.08 is more than three sigma.
    assert 1.0 - np.mean(answers) == pytest.approx(0.25, abs=0.08)


@FAST
@given(samples())
def test_carriages_are_v_turned_about_w(sample):
    r = kinematics.carriage_directions(sample.geometry, sample.gamma)
    for k in range(3):
        expected = turned(sample.gamma[k], sample.geometry.w[k], sample.geometry.v[k])
        np.testing.assert_allclose(r[k], expected, atol=1e-15, rtol=0)


def test_full_stroke_brings_each_carriage_to_the_next_corner():
    for geometry, _ in random_geometries(10, seed=7):
        r = kinematics.carriage_directions(geometry, geometry.arc)
        np.testing.assert_allclose(r, np.roll(geometry.v, -1, axis=0), atol=1e-15)


def test_star_arcs_enclose_the_angles_alpha():
    for geometry, _ in random_geometries(10, seed=8):
        for k in range(3):
            following = turned(geometry.alpha[k], [0.0, 0.0, 1.0], geometry.e[k])
            np.testing.assert_allclose(following, geometry.e[(k + 1) % 3], atol=1e-15, rtol=0)


def test_geometry_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        ISOTROPIC.v[0, 0] = 2.0


def test_no_admissible_assembly_says_where():
    gamma = np.array([0.05, 0.05, 1.5])
    assert not has_fermat_point(gamma)
    with pytest.raises(NoAdmissibleAssembly, match=r"gamma = \[0\.05 0\.05 1\.5 *\] rad") as caught:
        kinematics.admissible(ISOTROPIC, gamma)
    np.testing.assert_array_equal(caught.value.gamma, gamma)


def test_beta_max_narrows_what_is_admissible():
    narrow = Geometry.build(np.eye(3), np.radians([120.0] * 3), np.radians(35.0))
    with pytest.raises(NoAdmissibleAssembly):
        kinematics.admissible(narrow, HOME)


def ambiguous_posture():
    """The first posture of a seeded search over wide stars that two assemblies may take."""
    rng = np.random.default_rng(11)
    for _ in range(600):
        alpha = np.array([200.0, 80.0]) + rng.uniform(-20.0, 20.0, 2)
        alpha = np.append(alpha, 360.0 - alpha.sum())
        geometry, gamma = Geometry.build(np.eye(3), np.radians(alpha)), rng.uniform(0.1, 1.4, 3)
        if sum(assembly.admissible for assembly in kinematics.direct(geometry, gamma)) > 1:
            return geometry, gamma
    raise AssertionError("no ambiguous posture found")


def test_ambiguity_is_told_with_all_candidates():
    geometry, gamma = ambiguous_posture()
    said = "2 admissible assemblies, with the orientations"
    with pytest.raises(AmbiguousAssembly, match=said) as caught:
        kinematics.admissible(geometry, gamma)
    one, two = caught.value.candidates
    assert one.admissible
    assert two.admissible
    assert np.abs(one.rotation - two.rotation).max() > 1e-3
    for candidate in caught.value.candidates:
        assert np.abs(closure(geometry, gamma, candidate.rotation)).max() < 1e-13
        named = kinematics.admissible(geometry, gamma, near=candidate.rotation)
        assert np.array_equal(named.rotation, candidate.rotation)
    with pytest.raises(AmbiguousAssembly):
        kinematics.admissible(geometry, gamma, near=np.diag([-1.0, -1.0, 1.0]))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_gamma_that_is_not_finite_is_refused(bad):
    with pytest.raises(AssemblyError, match="finite"):
        kinematics.direct(ISOTROPIC, [0.7, bad, 0.7])


def test_gamma_of_another_shape_is_refused():
    with pytest.raises(AssemblyError, match="three"):
        kinematics.direct(ISOTROPIC, [0.7, 0.7])


def test_a_posture_with_a_family_of_assemblies_is_refused():
    """Carriages 1 and 2 meet at P2 and t_2 = -t_1: the star is free to turn about a line."""
    geometry = Geometry.build(np.eye(3), np.radians([180.0, 90.0, 90.0]))
    with pytest.raises(AssemblyError, match="not isolated"):
        kinematics.direct(geometry, [np.pi / 2, 0.0, 0.7])
