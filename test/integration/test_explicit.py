# SPDX-License-Identifier: Apache-2.0
"""Runge-Kutta methods against all their order conditions; their estimates on example 2.

Coefficients are rounded in their last digit and sums of DOP853 pass through numbers up to 1e2, so
a condition may be missed by some 1e-14; a wrong digit anywhere misses one by far more than 1e-13.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
from loaded_scenes import start_of

from sst_ros.dynamics import kernel
from sst_ros.integration import codegen
from sst_ros.integration.methods import DOP853, DORMAND_PRINCE, METHODS, Tableau
from sst_ros.scene.scene import load

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


def rates(t, *y):
    return kernel.derivative(MODEL, y, TORQUE(t))


def stepper(tableau, derivative, size=7):
    """One step by the text that runs: the new state, and its error estimate by number."""
    names = {"rhs": derivative, "sqrt": math.sqrt}
    exec(codegen.explicit_step(tableau, size, 0), names)

    def step(t, h, y):
        found = names["step"](t, h, *y)
        return found[:size], np.linalg.norm(found[size:])

    return step


@pytest.mark.parametrize(
    ("tableau", "steps"), [(DORMAND_PRINCE, 64), (DOP853, 48)], ids=["dopri5", "dop853"]
)
def test_estimates_shrink_by_their_order(tableau, steps):
    """In the median: where a weight of DOP853's passes zero a step has an estimate of order 6."""

    def median(count):
        step, y, h, estimates = stepper(tableau, rates), start_of(SCENE), SPAN / count, []
        for k in range(count):
            y, estimate = step(k * h, h, y)
            estimates.append(estimate)
        return np.median(estimates)

    order = math.log2(median(steps) / median(2 * steps))
    assert order == pytest.approx(tableau.error_order + 1, abs=0.05)


@pytest.mark.parametrize(
    ("tableau", "steps"), [(DORMAND_PRINCE, 40), (DOP853, 12)], ids=["dopri5", "dop853"]
)
def test_estimate_bounds_the_true_error_of_each_step(tableau, steps):
    """Truth: 8 small steps of DOP853, 8^8 times finer than its one and exact to rounding."""
    step, fine = stepper(tableau, rates), stepper(DOP853, rates)
    y, h = start_of(SCENE), SPAN / steps
    for k in range(steps):
        moved, estimate = step(k * h, h, y)
        truth = y
        for i in range(8):
            truth, _ = fine(k * h + i * h / 8, h / 8, truth)
        error = np.linalg.norm(np.subtract(moved, truth))
        assert 0.0 < error < estimate < 1e-4
        y = moved


@every_method
def test_times_of_the_stages_are_those_of_the_nodes(tableau):
    seen = []

    def derivative(t, *y):
        seen.append(t)
        return 0.0, 0.0

    assert stepper(tableau, derivative, 2)(2.0, 0.5, (1.0, 2.0)) == ((1.0, 2.0), 0.0)
    np.testing.assert_allclose(seen, 2.0 + 0.5 * np.array(tableau.c), rtol=1e-15)
