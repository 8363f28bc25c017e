# SPDX-License-Identifier: Apache-2.0
"""Orientation conventions against SciPy's Rotation and against products of plain
rotations.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST
from scipy.spatial.transform import Rotation

from sst_ros.mechanism.geometry import (
    angle_between,
    quaternion_of,
    rotation_matrix,
    unwrap_zyz,
    zyz_angles,
)

ROUNDING = 1e-14  # a few products of numbers up to 1 in double precision
angles = st.floats(-np.pi, np.pi)
poles = st.just(0.0) | st.floats(1e-290, np.pi)  # between them, sines have few digits


def zyz(angles):
    """R of (theta, phi, psi), or of a row of them each."""
    return Rotation.from_euler("ZYZ", angles).as_matrix()


@FAST
@given(angles, poles, angles)
def test_zyz_angles_and_quaternions_build_the_rotation_again(theta, phi, psi):
    given_rotation = Rotation.from_euler("ZYZ", [theta, phi, psi])
    rotation = given_rotation.as_matrix()
    found = zyz_angles(rotation)
    assert found[1] == pytest.approx(phi, abs=ROUNDING)
    for ours, given_angle in ((found[0], theta), (found[2], psi)):
        # Angles about z lose digits like 1 / sin(phi) near the poles, where psi carries
        # both.
        if np.sin(phi) > 1e-3:
            assert abs(
                np.exp(1j * ours) - np.exp(1j * given_angle)
            ) < ROUNDING / np.sin(phi)
    np.testing.assert_allclose(zyz(found), rotation, atol=ROUNDING, rtol=0)
    quaternion, scipys = quaternion_of(rotation), given_rotation.as_quat()
    assert quaternion[3] >= 0.0
    assert (
        min(np.abs(quaternion - scipys).max(), np.abs(quaternion + scipys).max())
        < ROUNDING
    )
    np.testing.assert_allclose(rotation_matrix(quaternion), rotation, atol=ROUNDING)
    batch = np.stack([rotation, np.eye(3)])
    np.testing.assert_array_equal(zyz_angles(batch), [zyz_angles(one) for one in batch])


@pytest.mark.parametrize(("phi", "expected"), [(0.0, 0.8), (np.pi, 0.2)])
def test_at_a_pole_theta_is_zero_and_psi_carries_all(phi, expected):
    flip = np.diag([np.cos(phi), 1.0, np.cos(phi)])
    rotation = zyz([0.3, 0.0, 0.0]) @ flip @ zyz([0.5, 0.0, 0.0])
    np.testing.assert_allclose(
        zyz_angles(rotation), [0.0, phi, expected], atol=ROUNDING
    )


@pytest.mark.parametrize("phi", [1e-9, 1e-12, np.pi - 1e-9])
def test_phi_keeps_its_digits_near_the_poles(phi):
    found = zyz_angles(
        zyz([0.4, 0.0, 0.0]) @ zyz([0.0, phi, 0.0]) @ zyz([1.1, 0.0, 0.0])
    )[1]
    assert np.sin(found) == pytest.approx(np.sin(phi), rel=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-15, 1e-12, 1e-8, 1e-3, 1.0, 3.0, np.pi])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angle_between_is_exact_for_tiny_and_for_large_angles(angle, sign):
    turned = [0.0, 0.0, sign * np.sin(angle / 2), sign * np.cos(angle / 2)]
    assert angle_between([0.0, 0.0, 0.0, 1.0], turned) == pytest.approx(angle, rel=1e-8)


@FAST
@given(angles, st.floats(0.0, np.pi), angles, angles)
def test_angle_between_is_the_angle_of_the_relative_rotation(theta, phi, psi, turn):
    first = zyz([theta, phi, psi])
    second = (
        first @ zyz([0.7, 1.1, 0.2]) @ zyz([turn, 0.0, 0.0]) @ zyz([0.7, 1.1, 0.2]).T
    )
    found = angle_between(quaternion_of(first), quaternion_of(second))
    # asin loses half the digits where the angle nears pi.
    assert found == pytest.approx(abs(turn), abs=1e-7)


def same(angles, rotations):
    np.testing.assert_allclose(zyz(angles), rotations, atol=1e-14)


def test_many_turns_of_every_angle():
    x = np.linspace(0, 1, 400)[:, None]
    angles = np.array([0.3, 0.8, -0.2]) + x * [14.0, 0.9, -25.0]
    rotations = zyz(angles)
    found = unwrap_zyz(zyz_angles(rotations))
    np.testing.assert_allclose(found, angles, atol=1e-12)
    same(found, rotations)


@pytest.mark.parametrize("samples", [200, 201])
def test_straight_through_the_pole(samples):
    """phi goes through 0 with theta and psi smooth.

    201 samples have one exactly at the pole.
    """
    x = np.linspace(-1, 1, samples)
    angles = np.stack([0.4 + 0.1 * x, -0.5 * x, 1.1 - 0.3 * x], axis=1)
    rotations = zyz(angles)
    raw = zyz_angles(rotations)
    assert np.abs(np.diff(raw[:, 0])).max() > 2.0  # the principal angles do jump
    found = unwrap_zyz(raw)
    assert np.abs(np.diff(found, axis=0)).max() < 0.02
    same(found, rotations)


@pytest.mark.parametrize("pole", [0.0, np.pi])
def test_resting_at_the_pole_keeps_theta_and_the_sum(pole):
    given = np.array(
        [[0.7, pole - np.sign(pole - 1) * 0.01, 0.2]] + [[0.0, pole, 0.9]] * 3
    )
    given[1:, 2] = [0.9, 1.0, 1.1] if pole == 0.0 else [-0.5, -0.4, -0.3]
    found = unwrap_zyz(given)
    np.testing.assert_allclose(found[1:, 0], 0.7)
    sign = 1.0 if pole == 0.0 else -1.0
    kept = found[:, 2] + sign * found[:, 0]
    np.testing.assert_allclose(kept, given[:, 2] + np.multiply(sign, [0.7, 0, 0, 0]))
    same(found, zyz(given))


def test_a_start_at_the_pole_takes_theta_from_what_follows():
    angles = np.stack([np.full(5, 2.0), 0.1 * np.arange(5), np.full(5, -1.0)], axis=1)
    found = unwrap_zyz(zyz_angles(zyz(angles)))
    np.testing.assert_allclose(found, angles, atol=1e-14)
