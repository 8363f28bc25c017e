# SPDX-License-Identifier: Apache-2.0
"""ZYZ angles of trajectories: no jumps, through and at the pole, and still the same rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sst_ros.mechanism.frames import unwrap_zyz, zyz_angles


def same(angles, rotations):
    again = Rotation.from_euler("ZYZ", angles).as_matrix()
    np.testing.assert_allclose(again, rotations, atol=1e-14)


def trajectory(angles):
    return Rotation.from_euler("ZYZ", angles).as_matrix()


def test_many_turns_of_every_angle():
    x = np.linspace(0, 1, 400)[:, None]
    angles = np.array([0.3, 0.8, -0.2]) + x * [14.0, 0.9, -25.0]
    rotations = trajectory(angles)
    found = unwrap_zyz(zyz_angles(rotations))
    np.testing.assert_allclose(found, angles, atol=1e-12)
    same(found, rotations)


@pytest.mark.parametrize("samples", [200, 201])
def test_straight_through_the_pole(samples):
    """phi goes through 0 with theta and psi smooth; 201 samples have one exactly at the pole."""
    x = np.linspace(-1, 1, samples)
    angles = np.stack([0.4 + 0.1 * x, -0.5 * x, 1.1 - 0.3 * x], axis=1)
    rotations = trajectory(angles)
    raw = zyz_angles(rotations)
    assert np.abs(np.diff(raw[:, 0])).max() > 2.0  # the principal angles do jump
    found = unwrap_zyz(raw)
    assert np.abs(np.diff(found, axis=0)).max() < 0.02
    same(found, rotations)


@pytest.mark.parametrize("pole", [0.0, np.pi])
def test_resting_at_the_pole_keeps_theta_and_the_sum(pole):
    given = np.array([[0.7, pole - np.sign(pole - 1) * 0.01, 0.2]] + [[0.0, pole, 0.9]] * 3)
    given[1:, 2] = [0.9, 1.0, 1.1] if pole == 0.0 else [-0.5, -0.4, -0.3]
    found = unwrap_zyz(given)
    np.testing.assert_allclose(found[1:, 0], 0.7)
    kept = found[:, 0] + found[:, 2] if pole == 0.0 else found[:, 2] - found[:, 0]
    np.testing.assert_allclose(kept, given[:, 2] + [0.7, 0, 0, 0] if pole == 0.0
                               else given[:, 2] - [0.7, 0, 0, 0])  # fmt: skip
    same(found, trajectory(given))


def test_a_start_at_the_pole_takes_theta_from_what_follows():
    angles = np.stack([np.full(5, 2.0), 0.1 * np.arange(5), np.full(5, -1.0)], axis=1)
    found = unwrap_zyz(zyz_angles(trajectory(angles)))
    np.testing.assert_allclose(found, angles, atol=1e-14)
