# SPDX-License-Identifier: Apache-2.0
"""The paper's equations against Lagrange's at 50 digits, and against differences of the motion.

Samples keep abs(det J2) > 0.05 and sin(mu) > 0.2, so J and the inertia matrix lose at most about
two digits of double precision: 1e-12 leaves two more for sums that cancel.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lagrange import OUTER, Lagrange, columns, spin, times
from mechanism.closed_chains import random_geometry, random_mechanism, random_pose
from models import FAST, agree, assembly_of, samples, seeded_samples, star_orientation
from mpmath import mpf
from scipy.optimize import brentq

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics, rates, virtual_work
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.virtual_work import EquationOfMotion

ISOTROPIC = seeded_samples(1, 6, isotropic=True)
GENERAL = seeded_samples(2, 6)
SAMPLES = [pytest.param(s, id=f"isotropic{i}") for i, s in enumerate(ISOTROPIC)]
SAMPLES += [pytest.param(s, id=f"general{i}") for i, s in enumerate(GENERAL)]
every_sample = pytest.mark.parametrize("sample", SAMPLES)


@every_sample
@pytest.mark.parametrize("pushed", [False, True])
def test_direct_dynamics_is_lagranges(sample, pushed):
    loads = (sample.torque, sample.moment) if pushed else (sample.torque,)
    truth = Lagrange(sample.scene, sample.rotation)
    arguments = (sample.mechanism, sample.posture, sample.gamma_dot)
    ours = virtual_work.direct_dynamics(*arguments, *loads)
    agree(ours, truth.acceleration(sample.gamma, sample.gamma_dot, *loads))


@every_sample
def test_t1_is_minus_the_inertia_matrix(sample):
    truth = Lagrange(sample.scene, sample.rotation).inertia_matrix([mpf(g) for g in sample.gamma])
    t1, _ = virtual_work.equation_of_motion(sample.mechanism, sample.posture, sample.gamma_dot)
    agree(-t1, truth)


@every_sample
def test_link_frames_are_those_built_by_geometry(sample):
    truth = Lagrange(sample.scene, sample.rotation).frames([mpf(x) for x in sample.gamma])
    actuated, intermediate = virtual_work.link_frames(sample.posture)
    agree(actuated, truth[1:4])
    agree(intermediate, truth[4:7])


def test_the_truth_does_not_depend_on_its_steps():
    """Halving nothing but the digits left: frame spins at 1e-16 and 1e-10 agree to 1e-18."""
    sample = GENERAL[0]
    truth = Lagrange(sample.scene, sample.rotation)
    gamma, rate = ([mpf(x) for x in a] for a in (sample.gamma, sample.gamma_dot))
    path = truth.motion(gamma, rate, [0, 0, 0])
    frames = (truth.rotation(path(t)) for t in (-OUTER, OUTER, mpf(0)))
    coarse = times(columns(*truth.rotation(gamma)), spin(*frames, OUTER))
    fine = truth.spins(gamma, rate)[0]
    assert max(abs(x - y) for x, y in zip(coarse, fine, strict=True)) < 1e-17
    assert max(abs(x - y) for x, y in zip(coarse, fine, strict=True)) > 0


@FAST
@given(samples())
def test_t1_is_symmetric_and_negative_definite(sample):
    t1, _ = virtual_work.equation_of_motion(sample.mechanism, sample.posture, sample.gamma_dot)
    agree(t1, t1.T, np.abs(t1).max())
    assert np.linalg.eigvalsh((t1 + t1.T) / 2.0)[-1] < 0.0


@FAST
@given(samples())
def test_inverse_dynamics_undoes_direct_dynamics(sample):
    arguments = (sample.mechanism, sample.posture, sample.gamma_dot)
    gamma_ddot = virtual_work.direct_dynamics(*arguments, sample.torque, sample.moment)
    torque = virtual_work.inverse_dynamics(*arguments, gamma_ddot, sample.moment)
    _, t2 = virtual_work.equation_of_motion(*arguments, sample.moment)
    # The torque is what is left of T1 gamma_ddot and T2, which may be larger than it.
    size = np.abs(sample.torque).max() + np.abs(t2).max()
    agree(torque, sample.torque, size)


WIDE_STAR = Geometry.build(np.eye(3), np.radians([210.0, 75.0, 75.0]))


def wide_star_pose(numbers):
    """R, gamma and the assembly of the wide star with E inside the base triangle."""
    rotation = star_orientation(WIDE_STAR, numbers)
    gamma, _, _ = kinematics.inverse(WIDE_STAR, rotation)
    return rotation, gamma, assembly_of(WIDE_STAR, gamma, rotation)


def numbers_of_a_singular_pose():
    """Between two admissible poses on either side of det J2 = 0."""
    rng, ends = np.random.default_rng(0), {}
    while len(ends) < 2:
        numbers = rng.uniform(-1.0, 1.0, 4)
        assembly = wide_star_pose(numbers)[2]
        if assembly.admissible:
            ends[assembly.det_j2 > 0.0] = numbers
    low, high = ends[False], ends[True]
    along = brentq(lambda x: wide_star_pose(low + x * (high - low))[2].det_j2, 0.0, 1.0, xtol=1e-15)
    return low + along * (high - low)


def test_a_wide_star_meets_a_parallel_singularity_and_is_told_so():
    rotation, gamma, _ = wide_star_pose(numbers_of_a_singular_pose())
    with pytest.raises(SingularConfiguration, match="parallel") as caught:
        virtual_work.posture(WIDE_STAR, gamma, rotation)
    assert abs(caught.value.measure) < 1e-12


def test_a_serial_singularity_is_told():
    geometry = Geometry.build(np.eye(3), np.radians([120.0] * 3))
    t, x = geometry.w[0], np.array([1.0, 0.0, 0.0])
    assert t @ x == 0.0
    s = np.cos(0.7) * x + np.sin(0.7) * np.cross(t, x)
    rotation = np.stack([np.cross(t, s), t, s], axis=1)
    gamma, _, _ = kinematics.inverse(geometry, rotation)
    with pytest.raises(SingularConfiguration, match="serial"):
        virtual_work.posture(geometry, gamma, rotation)


def test_posture_takes_the_admissible_assembly_by_itself():
    geometry = Geometry.build(np.eye(3), np.radians([120.0] * 3))
    gamma = [0.7, 0.8, 0.9]
    chosen = kinematics.admissible(geometry, gamma).rotation
    assert np.array_equal(virtual_work.posture(geometry, gamma).rotation, chosen)


@settings(max_examples=80)
@given(st.integers(0, 2**32 - 1))
def test_energy_momentum_and_both_dynamics_agree(seed):
    rng = np.random.default_rng(seed)
    geometry = random_geometry(rng)
    mechanism = random_mechanism(rng, geometry)
    gamma, rotation = random_pose(rng, geometry)
    rate, torque, moment = rng.normal(size=(3, 3))
    at = virtual_work.posture(geometry, gamma, rotation)
    found = EquationOfMotion.of(mechanism, at, rate)
    assert np.linalg.eigvalsh(found.m)[0] > 0
    # Kinetic energy of the seven links, one by one.
    motion = rates.of_actuators(at, rate)
    body = rotation.T @ motion.omega
    energy = body @ mechanism.star @ body
    for k in range(3):
        energy += motion.omega_a[k] @ mechanism.actuated[k] @ motion.omega_a[k]
        energy += motion.omega_ipl[k] @ mechanism.intermediate[k] @ motion.omega_ipl[k]
    np.testing.assert_allclose(found.kinetic_energy, energy / 2, rtol=1e-12)
    np.testing.assert_allclose(rate @ found.momentum, energy, rtol=1e-12)
    np.testing.assert_allclose(
        found.power(torque, moment), torque @ rate + moment @ motion.omega, rtol=1e-10, atol=1e-12
    )
    acceleration = found.acceleration(torque, moment)
    size = np.linalg.norm(acceleration)
    other = virtual_work.direct_dynamics(mechanism, at, rate, torque, moment)
    assert np.linalg.norm(acceleration - other) <= 1e-11 * size
    scale = np.linalg.norm(found.m) * size + np.linalg.norm(found.h) + np.linalg.norm(torque)
    assert np.linalg.norm(found.torque(acceleration, moment) - torque) <= 1e-12 * scale
