# SPDX-License-Identifier: Apache-2.0
"""Every assembly, none missing and none too many; the inverse.

Which assembly is meant.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism.closed_chains import (
    FOLDING,
    ISOTROPIC,
    census,
    complex_zeros,
    exact_rotations,
    quadrics,
    random_geometry,
    random_pose,
    random_rotation,
    same_rotations,
)
from models import FAST, assembly_of, samples
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from slow_cases import slow_after

from sst_ros.errors import AmbiguousAssembly, AssemblyError, NoAdmissibleAssembly
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.geometry import Geometry

HOME = np.full(3, np.pi / 4)
SEEDS = st.integers(0, 2**32 - 1)


def turned(angle, axis, vector):
    return Rotation.from_rotvec(angle * np.array(axis)).as_matrix() @ vector


# All assemblies, against the zeros of quadrics by Bezout.


def solve(geometry, gammas):
    found = kinematics.direct_many(geometry, gammas)
    r = kinematics.carriage_directions(geometry, gammas)[found.configuration]
    t = geometry.e @ found.rotation.transpose(0, 2, 1)
    assert np.abs(np.sum(r * t, axis=2)).max(initial=0.0) <= 1e-14
    assert np.all(found.isolated)
    return found.configuration, found.rotation, found.admissible


def isotropic(count, rng):
    return [ISOTROPIC] * (count // 100), list(
        rng.uniform(0, np.pi / 2, (count // 100, 100, 3))
    )


def general(count, rng):
    geometries = [random_geometry(rng) for _ in range(count // 10)]
    return geometries, [
        rng.uniform(0, 1, (10, 3)) * geometry.arc for geometry in geometries
    ]


@pytest.mark.parametrize("kind", slow_after(1, [isotropic, general]))
@pytest.mark.parametrize(
    ("count", "hardest"),
    [(1000, 10), pytest.param(10_000, 200, marks=pytest.mark.slow)],
)
def test_the_assemblies_are_all_the_real_zeros(kind, count, hardest):
    configurations, missing, spurious, gap = census(
        solve, *kind(count, np.random.default_rng(1)), hardest
    )
    assert configurations == count
    assert gap > 1e-6  # all eight complex zeros are known and distinct: none is missing
    assert (missing, spurious) == (0, 0)


def folds(count, seed):
    """gamma at which two assemblies meet: det J2 = 0 on a random arc of rotations."""
    rng = np.random.default_rng(seed)
    while count:
        geometry, start = random_geometry(rng), random_rotation(rng)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)

        def pose(x, axis=axis, start=start):
            return turned(x, axis, start)

        def volume(x, geometry=geometry, pose=pose):
            gamma = kinematics.inverse(geometry, pose(x))[0]
            return assembly_of(geometry, gamma, pose(x)).det_j2

        values = [volume(x) for x in np.linspace(0, 3, 20)]
        for i in range(19):
            if values[i] * values[i + 1] < 0:
                x = brentq(volume, 3 * i / 19, 3 * (i + 1) / 19, xtol=1e-16)
                yield (
                    geometry,
                    kinematics.inverse(geometry, pose(x))[0],
                    rng.normal(size=3),
                )
                count -= 1
                break


@pytest.mark.parametrize("distance", slow_after(1, [1e-4, 1e-8, 1e-11]))
def test_near_double_assemblies_on_both_sides_of_a_fold(distance):
    for geometry, gamma, direction in folds(6, seed=3):
        for sign in (-1, 1):
            point = gamma + sign * distance * direction / np.linalg.norm(direction)
            r = kinematics.carriage_directions(geometry, point)
            zeros, _ = complex_zeros(quadrics(r[None], geometry.e[None]))
            expected = exact_rotations(r, geometry.e, zeros[0])
            _, found, _ = solve(geometry, point[None])
            assert same_rotations(found, expected, 1e-9) == (0, 0)


def test_assemblies_that_meet_do_not_vanish():
    """In doubles the pair that meets is one, or two on either side of det J2 = 0."""
    for geometry, gamma, _ in folds(20, seed=4):
        found = kinematics.direct(geometry, gamma)
        singular = [assembly for assembly in found if abs(assembly.det_j2) < 1e-6]
        assert len(singular) in (2, 4)
        if len(singular) == 4:
            first, second = singular[0], singular[2]
            side = np.sign(first.rotation[:, 1] @ second.rotation[:, 1])
            assert side * first.det_j2 * second.det_j2 < 0
            assert np.abs(first.rotation[:, 2] - second.rotation[:, 2]).max() < 1e-6


def test_many_at_once_have_the_bits_and_the_order_of_one_by_one():
    rng = np.random.default_rng(2)
    for geometry in (ISOTROPIC, FOLDING, random_geometry(rng)):
        gammas = rng.uniform(0, 1, (40, 3)) * geometry.arc
        many = kinematics.direct_many(geometry, gammas)
        for row, gamma in enumerate(gammas):
            one = [assembly.rotation for assembly in kinematics.direct(geometry, gamma)]
            mine = many.rotation[many.configuration == row]
            assert len(one) == len(mine)
            np.testing.assert_allclose(
                np.reshape(one, (-1, 3, 3)), mine, rtol=0, atol=1e-12
            )
        again = kinematics.direct_many(geometry, gammas)
        assert again.rotation.tobytes() == many.rotation.tobytes()
        s = many.rotation[:, :, 2]
        np.testing.assert_array_equal(s[::2], s[1::2])


# The inverse, and both ways together.


def same_angles(found, expected):
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * expected), atol=1e-12)


@settings(max_examples=50)
@given(SEEDS)
def test_inverse_of_direct_is_gamma_again(seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(rng)
    gamma = rng.uniform(0, 1, 3) * geometry.arc
    for assembly in kinematics.direct(geometry, gamma):
        if min(abs(assembly.det_j2), np.abs(np.sin(assembly.mu)).min()) < 0.05:
            continue
        signs = np.where(np.sin(assembly.mu) > 0, 1, -1)
        again, mu, beta = kinematics.inverse(geometry, assembly.rotation, signs)
        np.testing.assert_allclose(
            [again, mu], [gamma, assembly.mu], rtol=1e-12, atol=1e-12
        )
        same_angles(beta, assembly.beta)


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1)])
def test_every_branch_of_the_inverse_closes_the_loops(signs):
    rng = np.random.default_rng(6)
    for _ in range(20):
        geometry = random_geometry(rng)
        _, rotation = random_pose(rng, geometry)
        gamma, mu, beta = kinematics.inverse(geometry, rotation, signs)
        described = assembly_of(geometry, gamma, rotation)
        assert np.abs(kinematics.closure(geometry, gamma, rotation)).max() < 1e-14
        np.testing.assert_allclose(described.mu, mu, atol=1e-12)
        same_angles(described.beta, beta)
        assert np.all(np.sign(mu) == signs)


# The geometry itself.


def test_home_of_the_isotropic_design():
    home = kinematics.admissible(ISOTROPIC, HOME)
    np.testing.assert_allclose(np.degrees(home.mu), 90.0, atol=1e-12)
    beta = np.degrees(np.arcsin(1.0 / np.sqrt(3.0)))
    assert beta == pytest.approx(35.2644, abs=1e-4)
    np.testing.assert_allclose(np.degrees(home.beta), beta, atol=1e-12)
    np.testing.assert_allclose(home.rotation[:, 2], np.full(3, 3.0**-0.5), atol=1e-14)
    # There J is a permutation.
    j = np.abs(virtual_work.posture(ISOTROPIC, HOME).j)
    for axis in (0, 1):
        ordered = np.sort(j, axis=axis)
        np.testing.assert_allclose(
            np.moveaxis(ordered, axis, 1), [[0, 0, 1]] * 3, atol=1e-14
        )


def has_fermat_point(gamma):
    """All angles of the spherical triangle r1 r2 r3 are below 120 deg."""
    r = kinematics.carriage_directions(ISOTROPIC, gamma)
    for k in range(3):
        one, two = np.cross(r[k], r[k - 1]), np.cross(r[k], r[k - 2])
        angle = np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)
        if angle >= np.radians(120.0):
            return False
    return True


def test_an_isotropic_pose_exists_iff_there_is_a_fermat_point():
    sweep = np.random.default_rng(5).uniform(0.02, np.pi / 2 - 0.02, (400, 3))
    many = kinematics.direct_many(ISOTROPIC, sweep)
    answers = np.isin(np.arange(400), many.configuration[many.admissible]).tolist()
    assert answers == [has_fermat_point(gamma) for gamma in sweep]


def test_share_of_actuator_angles_without_a_pose():
    gamma = np.random.default_rng(6).uniform(0.0, np.pi / 2.0, (400_000, 3))
    cosine, sine, zero = np.cos(gamma), np.sin(gamma), np.zeros(len(gamma))
    carriages = (
        np.stack([cosine[:, 0], sine[:, 0], zero], axis=1),
        np.stack([zero, cosine[:, 1], sine[:, 1]], axis=1),
        np.stack([sine[:, 2], zero, cosine[:, 2]], axis=1),
    )
    exists = np.ones(len(gamma), dtype=bool)
    for k in range(3):
        one = np.cross(carriages[k], carriages[k - 1])
        two = np.cross(carriages[k], carriages[k - 2])
        sine_of_angle = np.linalg.norm(np.cross(one, two), axis=1)
        angle = np.arctan2(sine_of_angle, np.sum(one * two, axis=1))
        exists &= angle < np.radians(120.0)
    # docs/theory.md; of 400,000 the standard deviation is 0.0007
    assert 1.0 - np.mean(exists) == pytest.approx(0.2583, abs=0.003)


@FAST
@given(samples())
def test_carriages_and_arcs_are_vectors_turned_about_axes(sample):
    geometry = sample.geometry
    r = kinematics.carriage_directions(geometry, sample.gamma)
    for k in range(3):
        expected = turned(sample.gamma[k], geometry.w[k], geometry.v[k])
        np.testing.assert_allclose(r[k], expected, atol=1e-15, rtol=0)
        # Sums of three angles up to 2 pi, whose last place is 8.9e-16; 1.3e-15 in 4,000
        # samples.
        following = turned(geometry.alpha[k], [0.0, 0.0, 1.0], geometry.e[k])
        np.testing.assert_allclose(
            following, geometry.e[(k + 1) % 3], atol=4e-15, rtol=0
        )
    ends = kinematics.carriage_directions(geometry, geometry.arc)
    np.testing.assert_allclose(ends, np.roll(geometry.v, -1, axis=0), atol=1e-15)


# Which assembly is meant, and what is refused.


def test_no_admissible_assembly_says_where():
    gamma = np.array([0.05, 0.05, 1.5])
    assert not has_fermat_point(gamma)
    with pytest.raises(
        NoAdmissibleAssembly, match=r"gamma = \[0\.05 0\.05 1\.5 *\] rad"
    ) as caught:
        kinematics.admissible(ISOTROPIC, gamma)
    np.testing.assert_array_equal(caught.value.gamma, gamma)


def test_beta_max_narrows_what_is_admissible():
    narrow = Geometry.build(np.eye(3), np.radians([120.0] * 3), np.radians(35.0))
    with pytest.raises(NoAdmissibleAssembly):
        kinematics.admissible(narrow, HOME)


def test_ambiguity_is_told_with_all_candidates():
    geometry = Geometry.build(np.eye(3), np.radians([215.0, 70.0, 75.0]))  # a wide star
    gamma = np.full(3, 0.4)
    said = "2 admissible assemblies, with the orientations"
    with pytest.raises(AmbiguousAssembly, match=said) as caught:
        kinematics.admissible(geometry, gamma)
    one, two = caught.value.candidates
    assert not (
        one.rotation.flags.writeable
        or one.mu.flags.writeable
        or geometry.v.flags.writeable
    )
    assert one.admissible and two.admissible
    assert np.abs(one.rotation - two.rotation).max() > 1e-3
    for candidate in caught.value.candidates:
        named = kinematics.admissible(geometry, gamma, near=candidate.rotation)
        assert np.array_equal(named.rotation, candidate.rotation)
    with pytest.raises(AmbiguousAssembly):
        kinematics.admissible(geometry, gamma, near=np.diag([-1.0, -1.0, 1.0]))


# Carriages 1 and 2 meet at P2 and t_2 = -t_1: the star is free to turn about a line.
LOOSE = Geometry.build(np.eye(3), np.radians([180.0, 90.0, 90.0]))


@pytest.mark.parametrize(
    ("geometry", "gamma", "said"),
    [
        *((ISOTROPIC, [0.7, bad, 0.7], "finite") for bad in (np.nan, np.inf, -np.inf)),
        (ISOTROPIC, [0.7, 0.7], "three"),
        (LOOSE, [np.pi / 2, 0.0, 0.7], "not isolated"),
    ],
)
def test_gamma_without_a_finite_number_of_assemblies_is_refused(geometry, gamma, said):
    with pytest.raises(AssemblyError, match=said):
        kinematics.direct(geometry, gamma)
