# SPDX-License-Identifier: Apache-2.0
"""Runge-Kutta methods against all their order conditions and against the motion of example 2.

Coefficients are rounded in their last digit and sums of DOP853 pass through numbers up to 1e2, so
a condition may be missed by some 1e-14; a wrong digit anywhere misses one by far more than 1e-13.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
from integration.explicit_method import ExplicitMethod
from scipy.integrate import solve_ivp

from sst_ros.dynamics import kernel
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, RK4, Tableau
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

CONDITION = 1e-13
EXPLICIT = [method for method in METHODS.values() if isinstance(method, Tableau)]
every_method = pytest.mark.parametrize("tableau", EXPLICIT, ids=lambda t: t.name)


def trees(order):
    """Rooted trees with `order` nodes, as sorted tuples of their branches."""
    return forests(order - 1, order - 1)


def forests(nodes, largest):
    """Multisets of trees with `nodes` nodes in all, each of at most `largest` nodes."""
    if nodes == 0:
        return [()]
    found = []
    for size in range(min(nodes, largest), 0, -1):
        for count in range(1, nodes // size + 1):
            for rest in forests(nodes - size * count, size - 1):
                for same in combinations_with_replacement(trees(size), count):
                    found.append((*same, *rest))
    return found


def nodes_of(tree):
    return 1 + sum(map(nodes_of, tree))


def density(tree):
    return nodes_of(tree) * math.prod(map(density, tree))


def stage_weights(tree, a):
    """Elementary weights of the stages, Hairer I, section II.2."""
    weights = np.ones(len(a))
    for branch in tree:
        weights = weights * (a @ stage_weights(branch, a))
    return weights


def matrix(tableau):
    stages = len(tableau.b)
    return np.array([[*row, *[0.0] * (stages - len(row))] for row in tableau.a])


def all_trees(most):
    return [tree for order in range(1, most + 1) for tree in trees(order)]


def test_there_are_as_many_trees_as_the_book_counts():
    assert [len(trees(order)) for order in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@every_method
def test_rows_sum_to_the_nodes(tableau):
    np.testing.assert_allclose(matrix(tableau).sum(axis=1), tableau.c, atol=CONDITION)


@every_method
def test_weights_meet_every_order_condition(tableau):
    a, b = matrix(tableau), np.array(tableau.b)
    for tree in all_trees(tableau.order):
        assert abs(b @ stage_weights(tree, a) - 1.0 / density(tree)) < CONDITION


@every_method
def test_weights_do_not_meet_those_of_the_next_order(tableau):
    a, b = matrix(tableau), np.array(tableau.b)
    misses = [
        abs(b @ stage_weights(tree, a) - 1.0 / density(tree)) for tree in trees(tableau.order + 1)
    ]
    assert max(misses) > 1e-8


@pytest.mark.parametrize(
    ("weights", "tableau", "order"),
    [
        (DORMAND_PRINCE.error, DORMAND_PRINCE, 4),
        (DOP853.error, DOP853, 5),
        (DOP853.damping, DOP853, 3),
    ],
    ids=["dopri5", "dop853-error", "dop853-damping"],
)
def test_error_weights_vanish_up_to_the_embedded_order_and_no_further(weights, tableau, order):
    a, e = matrix(tableau), np.array(weights)
    for tree in all_trees(order):
        assert abs(e @ stage_weights(tree, a)) < CONDITION
    assert max(abs(e @ stage_weights(tree, a)) for tree in trees(order + 1)) > 1e-6


SCENE = load("example2_heavy")
MODEL = kernel.model_of(SCENE)
TORQUE = SCENE.torque.at
SPAN = 0.4


def rates(t, y):
    return kernel.derivative(MODEL, tuple(y), TORQUE(t))


def start():
    state = Simulation(SCENE).state
    return (*state.quaternion, *state.body_rate)


@pytest.fixture(scope="module")
def reference():
    """SciPy at its tightest tolerance, in steps short enough that rounding alone is left."""
    run = solve_ivp(
        rates, (0.0, SPAN), start(), method="DOP853", rtol=2.3e-14, atol=1e-15, max_step=0.002
    )
    return run.y[:, -1]


def run(tableau, steps):
    method, y, h, estimate = ExplicitMethod(tableau), start(), SPAN / steps, 0.0
    for k in range(steps):
        y, error = method.step(rates, k * h, y, h)
        estimate += error
    return np.array(y), estimate


def slope(coarse, fine, ratio=2.0):
    return math.log(coarse / fine) / math.log(ratio)


@pytest.mark.parametrize(
    ("tableau", "steps"),
    [(RK4, 128), (DORMAND_PRINCE, 128), (DOP853, 16)],
    ids=["rk4", "dopri5", "dop853"],
)
def test_measured_order_of_convergence(tableau, steps, reference):
    """Steps short enough for the leading term to rule, and errors well above rounding (4e-15)."""
    coarse, fine = (np.linalg.norm(run(tableau, n)[0] - reference) for n in (steps, 2 * steps))
    assert fine > 1e-14
    assert slope(coarse, fine) == pytest.approx(tableau.order, abs=0.1)


@pytest.mark.parametrize(
    ("tableau", "steps"), [(DORMAND_PRINCE, 64), (DOP853, 24)], ids=["dopri5", "dop853"]
)
def test_summed_estimates_shrink_by_their_order(tableau, steps):
    """Each is of order h^(p+1); there are 1/h of them."""
    coarse, fine = (run(tableau, n)[1] for n in (steps, 2 * steps))
    assert slope(coarse, fine) == pytest.approx(tableau.error_order, abs=0.05)


@pytest.mark.parametrize(
    ("tableau", "steps"), [(DORMAND_PRINCE, 40), (DOP853, 12)], ids=["dopri5", "dop853"]
)
def test_estimate_bounds_the_true_error_of_each_step(tableau, steps):
    """Truth: 8 small steps of DOP853, 8^8 times finer than its one and exact to rounding."""
    method, fine = ExplicitMethod(tableau), ExplicitMethod(DOP853)
    y, h = start(), SPAN / steps
    for k in range(steps):
        moved, estimate = method.step(rates, k * h, y, h)
        truth = y
        for i in range(8):
            truth = fine.step(rates, k * h + i * h / 8, truth, h / 8).y
        error = np.linalg.norm(np.subtract(moved, truth))
        assert 0.0 < error < estimate < 1e-4
        y = moved


def test_rk4_has_no_estimate():
    assert math.isnan(ExplicitMethod(RK4).step(lambda t, y: (y[0],), 0.0, (1.0,), 0.1).error)


@every_method
def test_times_of_the_stages_are_those_of_the_nodes(tableau):
    seen = []

    def derivative(t, y):
        seen.append(t)
        return (0.0,)

    ExplicitMethod(tableau).step(derivative, 2.0, (1.0,), 0.5)
    np.testing.assert_allclose(seen, 2.0 + 0.5 * np.array(tableau.c), rtol=1e-15)


@every_method
def test_a_polynomial_of_the_order_is_integrated_exactly(tableau):
    """y' = t^(p-1) is pure quadrature: exact but for a few roundings."""
    p = tableau.order
    end = ExplicitMethod(tableau).step(lambda t, y: (t ** (p - 1),), 0.0, (0.0,), 1.0).y[0]
    assert end == pytest.approx(1.0 / p, abs=1e-14)


def test_no_motion_has_no_error():
    step = ExplicitMethod(DOP853).step(lambda t, y: (0.0, 0.0), 0.0, (1.0, 2.0), 0.1)
    assert step == ((1.0, 2.0), 0.0)
