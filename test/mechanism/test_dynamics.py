# SPDX-License-Identifier: Apache-2.0
"""M, h, energy, momentum and power hold together for full inertia tensors of all links."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism.closed_chains import random_geometry, random_mechanism, random_pose

from sst_ros.mechanism import rates, virtual_work
from sst_ros.mechanism.virtual_work import EquationOfMotion


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
