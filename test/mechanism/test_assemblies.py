# SPDX-License-Identifier: Apache-2.0
"""Every assembly, none missing and none too many, against the zeros of quadrics by Bezout."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
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
from models import assembly_of
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from sst_ros.errors import AssemblyError
from sst_ros.mechanism import kinematics

SEEDS = st.integers(0, 2**32 - 1)


def solve(geometry, gammas):
    found = kinematics.direct_many(geometry, gammas)
    r = kinematics.carriage_directions(geometry, gammas)[found.configuration]
    t = geometry.e @ found.rotation.transpose(0, 2, 1)
    assert np.abs(np.sum(r * t, axis=2)).max(initial=0.0) <= 1e-14
    assert np.all(found.isolated)
    return found.configuration, found.rotation, found.admissible


def isotropic(count, rng):
    return [ISOTROPIC] * (count // 100), list(rng.uniform(0, np.pi / 2, (count // 100, 100, 3)))


def general(count, rng):
    geometries = [random_geometry(rng) for _ in range(count // 10)]
    return geometries, [rng.uniform(0, 1, (10, 3)) * geometry.arc for geometry in geometries]


@pytest.mark.parametrize(
    ("kind", "count", "hardest"),
    [
        (isotropic, 1000, 10),
        (general, 1000, 10),
        pytest.param(isotropic, 10_000, 200, marks=pytest.mark.slow),
        pytest.param(general, 10_000, 200, marks=pytest.mark.slow),
    ],
)
def test_the_assemblies_are_all_the_real_zeros(kind, count, hardest):
    result = census(solve, *kind(count, np.random.default_rng(1)), hardest)
    print(result)
    assert result.configurations == count
    assert result.nearest > 1e-6  # all eight complex zeros are known and distinct: none is missing
    assert (result.missing, result.spurious) == (0, 0)


def folds(count, seed):
    """gamma at which two assemblies meet: det J2 = 0 on a random arc of rotations."""
    rng = np.random.default_rng(seed)
    while count:
        geometry, start = random_geometry(rng), random_rotation(rng)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)

        def pose(x, axis=axis, start=start):
            return Rotation.from_rotvec(x * axis).as_matrix() @ start

        def volume(x, geometry=geometry, pose=pose):
            t = geometry.e @ pose(x).T
            p = np.cross(t, geometry.w)
            return np.linalg.det(np.cross(p / np.linalg.norm(p, axis=1)[:, None], t))

        values = [volume(x) for x in np.linspace(0, 3, 20)]
        for i in range(19):
            if values[i] * values[i + 1] < 0:
                x = brentq(volume, 3 * i / 19, 3 * (i + 1) / 19, xtol=1e-16)
                yield geometry, kinematics.inverse(geometry, pose(x))[0], rng.normal(size=3)
                count -= 1
                break


@pytest.mark.parametrize("distance", [1e-4, 1e-8, 1e-11])
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


@pytest.mark.parametrize("gamma", [[0.0, 0.0, 0.0], [np.pi / 2] * 3])
def test_a_continuum_of_assemblies_is_told_as_such(gamma):
    found = kinematics.direct_many(ISOTROPIC, [gamma])
    if found.isolated[0]:
        assert len(kinematics.direct(ISOTROPIC, gamma)) == len(found.configuration)
    else:
        with pytest.raises(AssemblyError, match="not isolated"):
            kinematics.direct(ISOTROPIC, gamma)


def test_many_at_once_are_the_same_bits_and_in_the_same_order_as_one_by_one():
    rng = np.random.default_rng(2)
    for geometry in (ISOTROPIC, FOLDING, random_geometry(rng)):
        gammas = rng.uniform(0, 1, (40, 3)) * geometry.arc
        many = kinematics.direct_many(geometry, gammas)
        for row, gamma in enumerate(gammas):
            one = kinematics.direct(geometry, gamma)
            mine = many.rotation[many.configuration == row]
            assert len(one) == len(mine)
            for assembly, rotation in zip(one, mine, strict=True):
                np.testing.assert_allclose(assembly.rotation, rotation, rtol=0, atol=1e-12)
        again = kinematics.direct_many(geometry, gammas)
        assert again.rotation.tobytes() == many.rotation.tobytes()
        s = many.rotation[:, :, 2]
        np.testing.assert_array_equal(s[::2], s[1::2])


def test_none_of_the_arrays_can_be_written_to():
    assembly = kinematics.admissible(ISOTROPIC, [0.7, 0.8, 0.9])
    for array in (assembly.rotation, assembly.mu, assembly.beta):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


@settings(max_examples=150)
@given(SEEDS)
def test_direct_of_inverse_is_the_orientation_again(seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(rng)
    _, rotation = random_pose(rng, geometry)
    gamma, mu, beta = kinematics.inverse(geometry, rotation)
    best = min(
        kinematics.direct(geometry, gamma), key=lambda a: np.abs(a.rotation - rotation).max()
    )
    assert np.linalg.norm(best.rotation - rotation) <= 1e-12 * np.linalg.norm(rotation)
    assume(np.all(np.abs(np.abs(beta) - np.pi) > 1e-6))
    np.testing.assert_allclose(best.mu, mu, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(best.beta, beta, rtol=1e-12, atol=1e-12)


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
        np.testing.assert_allclose(again, gamma, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(mu, assembly.mu, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(np.exp(1j * beta), np.exp(1j * assembly.beta), atol=1e-12)


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1)])
def test_every_branch_of_the_inverse_closes_the_loops(signs):
    rng = np.random.default_rng(6)
    for _ in range(20):
        geometry = random_geometry(rng)
        _, rotation = random_pose(rng, geometry)
        gamma, mu, beta = kinematics.inverse(geometry, rotation, signs)
        described = assembly_of(geometry, gamma, rotation)
        r = kinematics.carriage_directions(geometry, gamma)
        assert np.abs(np.sum(r * (geometry.e @ rotation.T), axis=1)).max() < 1e-14
        np.testing.assert_allclose(described.mu, mu, atol=1e-12)
        np.testing.assert_allclose(np.exp(1j * described.beta), np.exp(1j * beta), atol=1e-12)
        assert np.all(np.sign(mu) == signs)
