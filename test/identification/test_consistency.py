# SPDX-License-Identifier: Apache-2.0
"""Consistent parameters: against closed forms and scipy's own constrained solver."""

import warnings

import numpy as np
import pytest
from scipy.optimize import minimize

from sst_ros.identification.consistency import (
    find_consistent_values,
    fit_weighted,
    make_cones,
    scales,
)
from sst_ros.identification.parameters import STANDARD

NAMES = tuple(f"star.{part}" for part in STANDARD)


def draw_points(rng, count):
    """Masses and places of points."""
    return rng.uniform(0.1, 1.0, count), rng.uniform(-0.2, 0.2, (count, 3))


def of_points(rng, count=6):
    """The ten parameters of point masses."""
    masses, places = draw_points(rng, count)
    inertia = sum(
        m * (p @ p * np.eye(3) - np.outer(p, p))
        for m, p in zip(masses, places, strict=True)
    )
    six = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return np.array([masses.sum(), *(masses @ places), *six])


def fitted(target, noise):
    """Estimates of parameters that are base parameters themselves."""
    columns = np.random.default_rng(0).normal(size=(40, 3, len(target)))
    return fit_weighted(columns, columns @ target, np.full(3, noise))


def pseudo_inertia(values, reach):
    constant, basis = make_cones(NAMES, reach)
    return (constant + np.tensordot(values, basis, 1))[0]


def consistent(names, given, fit, reach):
    """The nearest values of bodies that can exist, and their chi^2."""
    whole = np.eye(len(names))
    return find_consistent_values(names, given, whole, *fit[:2], reach)


def test_the_pseudo_inertia_is_the_sum_over_mass_of_p_p_t():
    masses, places = draw_points(np.random.default_rng(1), 4)
    expected = sum(
        m * np.outer([*p, 1.0], [*p, 1.0]) for m, p in zip(masses, places, strict=True)
    )
    found = pseudo_inertia(of_points(np.random.default_rng(1), 4), 1.0)
    assert np.abs(found - expected).max() < 1e-14


@pytest.mark.parametrize("points", [6, 3, 2, 1])
def test_estimates_of_a_body_that_exists_are_not_changed(points):
    """Flat bodies, rods and points, which lie on the boundary, are reached too."""
    rng = np.random.default_rng(points)
    target, given = of_points(rng, points), of_points(rng)
    values, excess = consistent(NAMES, given, fitted(target, 1e-9), 1.0)
    assert np.abs(values - target).max() < 1e-9 * np.abs(target).max()
    assert excess < 1e-2


def test_a_body_that_cannot_exist_is_replaced_by_the_nearest():
    """A negative principal moment of S: the optimum against SciPy's on the same
    problem.
    """
    names = tuple(f"star.{part}" for part in STANDARD[4:])
    given = np.array([0.3, 0.3, 0.2, 0.0, 0.0, 0.0])
    target = np.array([0.1, 0.1, 0.4, 0.02, 0.0, 0.01])  # zz > xx + yy
    fit = fitted(target, 1e-2)
    values, excess = consistent(names, given, fit, 1.0)
    assert excess > 25.0
    size = scales(names, given)

    def cost(x):
        off = fit[1] @ (x - fit[0])
        return 0.5 * off @ off + 0.5 * np.sum(((x - given) / size) ** 2)

    def second_moments(x):
        inertia = np.array([[x[0], x[3], x[4]], [x[3], x[1], x[5]], [x[4], x[5], x[2]]])
        return np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)

    limits = {"type": "ineq", "fun": second_moments}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "delta_grad == 0.0"
        expected = minimize(
            cost,
            given,
            constraints=limits,
            method="trust-constr",
            options={"maxiter": 3000},
        )
    assert second_moments(values)[0] > 0.0
    assert cost(values) == pytest.approx(expected.fun, rel=1e-6)
    assert np.abs(values - expected.x).max() < 1e-6


def test_a_centre_stays_in_reach_and_friction_is_not_negative():
    names = (*NAMES, "friction.gamma.viscous")
    given = np.append(of_points(np.random.default_rng(2)), 0.1)
    target = given.copy()
    target[1] = 0.5 * target[0]
    target[-1] = -0.1
    values, _ = consistent(names, given, fitted(target, 1e-1), 0.3)
    assert np.linalg.norm(values[1:4]) <= 0.3 * values[0]
    assert 0.0 < values[-1] < 1e-6
    assert np.linalg.eigvalsh(pseudo_inertia(values[:10], 0.3))[0] > 0.0
