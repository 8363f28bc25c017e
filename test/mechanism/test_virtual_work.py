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
from lagrange import Lagrange, exact
from mechanism.closed_chains import random_sample
from models import FAST, agree, samples, seeded_samples

from sst_ros.mechanism import kinematics, rates, virtual_work
from sst_ros.mechanism.geometry import Geometry
from sst_ros.mechanism.virtual_work import EquationOfMotion

SAMPLES = [*seeded_samples(1, 6, isotropic=True), *seeded_samples(2, 6)]
every_sample = pytest.mark.parametrize("sample", SAMPLES, ids=range(len(SAMPLES)))


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
    truth = Lagrange(sample.scene, sample.rotation).inertia_matrix(exact(sample.gamma))
    t1, _ = virtual_work.equation_of_motion(sample.mechanism, sample.posture, sample.gamma_dot)
    agree(-t1, truth)


@every_sample
def test_link_frames_are_those_built_by_geometry(sample):
    truth = Lagrange(sample.scene, sample.rotation).at(exact(sample.gamma)).frames
    actuated, intermediate = virtual_work.link_frames(sample.posture)
    agree(actuated, truth[1:4])
    agree(intermediate, truth[4:7])


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


def test_posture_takes_the_admissible_assembly_by_itself():
    geometry = Geometry.build(np.eye(3), np.radians([120.0] * 3))
    gamma = [0.7, 0.8, 0.9]
    chosen = kinematics.admissible(geometry, gamma).rotation
    assert np.array_equal(virtual_work.posture(geometry, gamma).rotation, chosen)


@settings(max_examples=80)
@given(st.integers(0, 2**32 - 1))
def test_energy_momentum_and_both_dynamics_agree(seed):
    sample = random_sample(np.random.default_rng(seed))
    mechanism, at, rate = sample.mechanism, sample.posture, sample.gamma_dot
    torque, moment = sample.torque, sample.moment
    found = EquationOfMotion.of(mechanism, at, rate)
    assert np.linalg.eigvalsh(found.m)[0] > 0
    # Kinetic energy of the seven links, one by one.
    motion = rates.of_actuators(at, rate)
    body = sample.rotation.T @ motion.omega
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
