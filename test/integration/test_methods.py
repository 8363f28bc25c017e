# SPDX-License-Identifier: Apache-2.0
"""Tables of coefficients against all their order conditions, and what the code makes of
them.

Explicit coefficients are rounded in their last digit and sums of DOP853 pass through
numbers up to 1e2, so a condition may be missed by some 1e-14; a wrong digit anywhere
misses one by far more than 1e-13. Those of Rodas5P are printed to 16 digits and go up
to 165; the code works with u = Gamma k (Hairer & Wanner II, section IV.7), here they
are turned back into alpha and gamma.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import mpmath
import numpy as np
import pytest
from loaded_scenes import start_of

from sst_ros.dynamics import kernel
from sst_ros.integration.methods import (
    DOP853,
    DORMAND_PRINCE,
    METHODS,
    RODAS5P,
    Tableau,
)
from sst_ros.integration.steps import Linearisation, explicit_step, rosenbrock_step
from sst_ros.scene.scene import load

CONDITION, ROSENBROCK_CONDITION = 1e-13, 1e-12
EXPLICIT = [method for method in METHODS.values() if isinstance(method, Tableau)]
every_method = pytest.mark.parametrize("tableau", EXPLICIT, ids=lambda t: t.name)
STAGES = len(RODAS5P.alpha)


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


def stage_weights(tree, many, single):
    """Elementary weights of the stages, Hairer I, section II.2.

    A node with a single branch takes the matrix `single`, which is alpha + gamma for a
    Rosenbrock method (II, section IV.7) and the same as `many` for an explicit one.
    """
    weights = np.ones(len(many))
    for branch in tree:
        matrix = single if len(tree) == 1 else many
        weights = weights * (matrix @ stage_weights(branch, many, single))
    return weights


def misses(order, weights, many, single=None, *, zero=False):
    """By how much the conditions of one order are missed.

    `zero` for the weights of an estimate.
    """
    single = many if single is None else single
    return [
        abs(
            weights @ stage_weights(tree, many, single)
            - (0.0 if zero else 1.0 / density(tree))
        )
        for tree in trees(order)
    ]


def square(rows, stages):
    return np.array([[*row, *[0.0] * (stages - len(row))] for row in rows])


def matrix(tableau):
    return square(tableau.a, len(tableau.b))


def test_there_are_as_many_trees_as_the_book_counts():
    assert [len(trees(order)) for order in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@every_method
def test_rows_sum_to_the_nodes(tableau):
    np.testing.assert_allclose(matrix(tableau).sum(axis=1), tableau.c, atol=CONDITION)


@every_method
def test_weights_meet_each_order_condition_but_none_of_the_next(tableau):
    a, b = matrix(tableau), np.array(tableau.b)
    for order in range(1, tableau.order + 1):
        assert max(misses(order, b, a)) < CONDITION
    assert max(misses(tableau.order + 1, b, a)) > 1e-8


@pytest.mark.parametrize(
    ("weights", "tableau", "order"),
    [
        (DORMAND_PRINCE.error, DORMAND_PRINCE, 4),
        (DOP853.error, DOP853, 5),
        (DOP853.damping, DOP853, 3),
    ],
    ids=["dopri5", "dop853-error", "dop853-damping"],
)
def test_error_weights_vanish_up_to_the_embedded_order_only(weights, tableau, order):
    a, e = matrix(tableau), np.array(weights)
    for lower in range(1, order + 1):
        assert max(misses(lower, e, a, zero=True)) < CONDITION
    assert max(misses(order + 1, e, a, zero=True)) > 1e-6


# The text that runs, on example 2.

SCENE = load("example2_heavy")
MODEL = kernel.model_of(SCENE)
TORQUE = SCENE.torque.at
SPAN = 0.4


def rates(t, y, _):
    return kernel.derivative(MODEL, y, TORQUE(t))


def stepper(tableau):
    """One step by the traced function: the new state, and its error estimate."""

    def step(t, h, y):
        moved, error = explicit_step(rates, tableau, t, h, y, [None] * len(tableau.a))
        return moved, np.linalg.norm(error)

    return step


def march(step, count):
    """Time, state, next state and error estimate of each step over SPAN."""
    y, h = start_of(SCENE), SPAN / count
    for k in range(count):
        moved, estimate = step(k * h, h, y)
        yield k * h, y, moved, estimate
        y = moved


@pytest.mark.parametrize(
    ("tableau", "many", "few"),
    [(DORMAND_PRINCE, 64, 40), (DOP853, 48, 12)],
    ids=["dopri5", "dop853"],
)
def test_estimates_shrink_by_their_order_and_bound_the_error(tableau, many, few):
    """In the median: where a weight of DOP853's passes zero a step has an estimate of
    order 6.

    Truth: 8 small steps of DOP853, 8^8 times finer than its one and exact to rounding.
    """
    step, fine, h = stepper(tableau), stepper(DOP853), SPAN / few / 8
    coarse, finer = (
        np.median([e for *_, e in march(step, n)]) for n in (many, 2 * many)
    )
    assert math.log2(coarse / finer) == pytest.approx(tableau.error_order + 1, abs=0.05)
    for t, truth, moved, estimate in march(step, few):
        for i in range(8):
            truth, _ = fine(t + i * h, h, truth)
        assert 0.0 < np.linalg.norm(np.subtract(moved, truth)) < estimate < 1e-4


# Rodas5P: L-stable, stiffly accurate, of order 5 for any system.


def matrices():
    """alpha_ij and gamma_ij (with the diagonal), and the weights b."""
    u_of_k = np.linalg.inv(np.eye(STAGES) / RODAS5P.gamma - square(RODAS5P.c, STAGES))
    weights = np.array([*RODAS5P.a[-1], 1.0])
    return square(RODAS5P.a, STAGES) @ u_of_k, u_of_k, weights @ u_of_k


def test_nodes_of_rodas5p_are_the_sums_of_their_rows():
    alpha, gamma, _ = matrices()
    for found, expected in (
        (alpha.sum(axis=1), RODAS5P.alpha),
        (gamma.sum(axis=1), RODAS5P.d),
        (np.diag(gamma), RODAS5P.gamma),
    ):
        np.testing.assert_allclose(found, expected, atol=ROSENBROCK_CONDITION)


@pytest.mark.parametrize("order", [4, 5], ids=["embedded", "solution"])
def test_rodas5p_has_order_five_and_its_embedded_solution_four(order):
    """The embedded one is the argument of the last stage, so that the estimate is the
    last u.
    """
    alpha, gamma, b = matrices()
    weights = b if order == 5 else alpha[-1]
    for lower in range(1, order + 1):
        assert max(misses(lower, weights, alpha, alpha + gamma)) < ROSENBROCK_CONDITION
    assert max(misses(order + 1, weights, alpha, alpha + gamma)) > 1e-6


def stability(z):
    """R(z) = 1 + z b (I - z B)^-1 1, in 50 digits."""
    alpha, gamma, b = matrices()
    beta = mpmath.matrix((alpha + gamma).tolist())
    solved = mpmath.lu_solve(mpmath.eye(STAGES) - z * beta, mpmath.ones(STAGES, 1))
    return 1 + z * sum(mpmath.mpf(float(b[i])) * solved[i] for i in range(STAGES))


def test_it_is_a_stable_and_damps_infinitely_fast_modes_to_zero():
    with mpmath.workdps(50):
        for exponent in range(-3, 9):
            assert abs(stability(mpmath.mpc(0, 10.0**exponent))) <= 1 + 1e-12
        # What is left is the rounding of the coefficients to 16 digits.
        assert abs(stability(mpmath.mpf(-1e12))) < 1e-10
        assert abs(stability(mpmath.mpc(-1e12, 1e12))) < 1e-10


def steps_of(y0, h, count, matrix_of, slope_of, by_time=lambda t: 0.0):
    """Take steps of a scalar equation by the very function that a simulation traces."""
    y = [y0]
    for k in range(count):
        t = k * h
        at = Linearisation([slope_of(t, y[0])], [by_time(t)], [[matrix_of(y[0])]])
        y = rosenbrock_step(
            lambda t, y, _: [slope_of(t, y[0])], at, RODAS5P, t, h, y, None
        ).state
    return y[0]


@pytest.mark.parametrize("rate", [1.0, 1e3, 1e6, 1e9])
def test_a_step_of_the_linear_equation_is_the_stability_function(
    rate,
):
    with mpmath.workdps(30):
        wanted = float(stability(mpmath.mpf(-0.5 * rate)).real)
    got = steps_of(1.0, 0.5, 1, lambda y: -rate, lambda t, y: -rate * y)
    assert got == pytest.approx(wanted, abs=1e-13)
    assert abs(got) < 1.0


def test_a_stiff_equation_follows_its_slow_part_in_large_steps():
    """Prothero & Robinson: y' = -1e6 (y - cos t) - sin t from y(0) = 1; y = cos t."""
    rate = 1e6
    got = steps_of(
        1.0,
        0.05,
        20,
        lambda y: -rate,
        lambda t, y: -rate * (y - math.cos(t)) - math.sin(t),
        lambda t: -rate * math.sin(t) - math.cos(t),
    )
    assert got == pytest.approx(math.cos(1.0), abs=1e-9)
