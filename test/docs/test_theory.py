# SPDX-License-Identifier: Apache-2.0
"""What docs/theory.md says of the paper's print."""

from pathlib import Path

import numpy as np
import pytest

from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import Geometry

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
ISOTROPIC = Geometry.build(np.eye(3), np.radians([120.0, 120.0, 120.0]))
GENERAL = Geometry.build(
    [[1.0, 0.0, 0.0], [0.2, 1.0, 0.1], [0.15, 0.25, 1.0]], np.radians([110.0, 130.0, 120.0])
)
HOME = np.full(3, np.pi / 4)
STEP = 1e-3


def motion(geometry):
    """Angles on a curve, and R, mu, beta there, seven instants around t = 0."""
    times = STEP * np.arange(-3, 4)[:, None]
    gamma = (
        [0.75, 0.7, 0.75]
        + times * np.array([0.8, -0.6, 0.5])
        + 0.5 * times**2 * np.array([2.0, 1.0, -3.0])
    )
    found = [kinematics.admissible(geometry, row) for row in gamma]
    return gamma, *(
        np.array([getattr(a, name) for a in found]) for name in ("rotation", "mu", "beta")
    )


def slope(values):
    """First derivative at the middle, of order 6."""
    weights = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / (60.0 * STEP)
    return np.tensordot(weights, values, 1)


def second_slope(values):
    weights = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / (180.0 * STEP**2)
    return np.tensordot(weights, values, 1)


def spin(matrix):
    return 0.5 * np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )


@pytest.fixture(scope="module")
def moving():
    """Everything in Eqs. 31 to 33 by differences of positions alone."""
    gamma, rotation, mu, beta = motion(GENERAL)
    middle = rotation[3]
    omega = spin(slope(rotation) @ middle.T)
    omega_dot = spin(second_slope(rotation) @ middle.T)
    r = kinematics.carriage_directions(GENERAL, gamma[3])
    t, w = GENERAL.e @ middle.T, GENERAL.w
    rates = slope(gamma), slope(mu), slope(beta)
    return r, t, w, omega, omega_dot, *rates, second_slope(gamma)


def test_eq_31_ends_in_r(moving):
    r, t, _, omega, *_ = moving
    product = np.sum(np.cross(r, t) * np.cross(omega, t), axis=1)
    np.testing.assert_allclose(product, r @ omega, atol=1e-14)
    assert np.abs(product - t @ omega).max() > 0.1


def test_the_signs_of_eq_33(moving):
    """omega_dot of R_ddot R^T has its symmetric part, omega omega^T, removed by `spin`."""
    r, t, w, omega, omega_dot, gamma_dot, mu_dot, beta_dot, gamma_ddot = moving
    normal = np.cross(r, t)
    common = np.sum(normal * w, axis=1) * gamma_ddot - normal @ omega_dot
    first = gamma_dot * mu_dot * np.sum(t * w, axis=1)
    second = beta_dot * (r @ omega)
    np.testing.assert_allclose(common + first - second, 0.0, atol=1e-6)
    assert np.abs(common - first + second).max() > 0.1


def test_the_leg_equation_has_two_minus_signs(moving):
    r, t, w, omega, _, gamma_dot, mu_dot, beta_dot, _ = moving
    turned = w * gamma_dot[:, None] - r * mu_dot[:, None] - t * beta_dot[:, None]
    np.testing.assert_allclose(turned, np.tile(omega, (3, 1)), atol=1e-8)


def test_the_quotient_of_eq_2_breaks_where_the_star_does_not():
    s = np.array([1.0, 1.0, 0.0]) / np.sqrt(
        2.0
    )  # E on the side P1 P2, where R_1 is too: beta_1 = 0
    rotation = np.stack([np.cross([0.0, 0.0, 1.0], s), np.array([0.0, 0.0, 1.0]), s], axis=1)
    r = kinematics.carriage_directions(ISOTROPIC, HOME)[0]
    assert np.linalg.norm(np.cross(s, r)) < 1e-15
    np.testing.assert_allclose(np.linalg.norm(ISOTROPIC.e @ rotation.T, axis=1), 1.0, atol=1e-15)


def test_the_other_sense_of_the_star_has_no_admissible_assembly():
    def admissible(geometry):
        return [a for a in kinematics.direct(geometry, HOME) if a.admissible]

    assert len(admissible(ISOTROPIC)) == 1
    arrays = {name: getattr(ISOTROPIC, name) for name in ("v", "w", "alpha", "arc", "beta_max")}
    other = Geometry(e=ISOTROPIC.e * [-1.0, 1.0, 1.0], **arrays)
    turn = np.arctan2(np.cross(other.e[0], other.e[1])[2], other.e[0] @ other.e[1])
    assert turn == pytest.approx(-np.radians(120.0))
    assert admissible(other) == []


def test_the_assumed_inertias_are_those_of_the_scenes():
    from sst_ros.scene.scene import load

    star, thin = load("example2_heavy").star.inertia, load("example2").star.inertia
    assert f"diag({thin.xx:g}, {thin.yy:g}, {thin.zz:g})" in PAGE
    assert thin == load("example1").star.inertia == load("example2_stroke").star.inertia
    assert star.xx / thin.xx == pytest.approx(1.25)
    link = load("example2").intermediate_links[0].inertia
    assert f"diag({link.xx:.0e}, {link.yy:g}, {link.zz:g})".replace("e-06", "e-6") in PAGE
    assert f"{load('example1').initial.gamma_dot[0]!r}" in PAGE
