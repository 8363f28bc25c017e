# SPDX-License-Identifier: Apache-2.0
"""RODAS4 as Hairer & Wanner define it: L-stable, stiffly accurate, of order 4 for any system.

The code works with u = Gamma k (II, section IV.7). Here the coefficients are turned back into
alpha and gamma, whose order conditions the book lists.
"""

from __future__ import annotations

import builtins
import math
from types import FunctionType

import mpmath
import numpy as np
import pytest

from sst_ros.integration import step_loops
from sst_ros.integration.methods import RODAS4

GAMMA = 0.25
CONDITION = 1e-12
"""Coefficients are printed to 16 digits, and go up to 34."""


def square(rows):
    return np.array([[*row, *[0.0] * (6 - len(row))] for row in rows])


def matrices():
    """alpha_ij and gamma_ij (with the diagonal), and the weights b."""
    u_of_k = np.linalg.inv(np.eye(6) / GAMMA - square(RODAS4.c))
    weights = np.array([*RODAS4.a[5], 1.0])
    return square(RODAS4.a) @ u_of_k, u_of_k, weights @ u_of_k


def steps_of(y0, h, count, matrix_of, slope_of, by_time=lambda t: 0.0):
    """Take steps of a scalar equation through the very text that a simulation runs."""
    names = {
        "SIZE": 1,
        "RODAS_A": [(*row, *(0.0,) * 5) for row in RODAS4.a],
        "RODAS_C": [(*row, *(0.0,) * 5) for row in RODAS4.c],
        "RODAS_ALPHA": RODAS4.alpha,
        "RODAS_D": RODAS4.d,
        "vector": lambda n: [0.0] * n,
        "square": lambda n: [[0.0] * n for _ in range(n)],
        "rows": lambda m, n: [[0.0] * n for _ in range(m)],
        "__builtins__": builtins,
    }

    def linearise(t, y, d, p, slope, by_t, matrix):
        slope[0], by_t[0], matrix[0][0] = slope_of(t, y[0]), by_time(t), matrix_of(y[0])

    def evaluate(t, y, d, p, slope):
        slope[0] = slope_of(t, y[0])

    names |= {"linearise": linearise, "evaluate": evaluate}
    for part in ("factorise", "substitute", "attempt_linearly_implicit"):
        names[part] = FunctionType(getattr(step_loops, part).__code__, names)
    attempt = names["attempt_linearly_implicit"]
    y, new, error = [y0], [0.0], [0.0]
    for k in range(count):
        attempt(k * h, h, y, y, (), (), new, error)
        y[0] = new[0]
    return y[0], error[0]


def test_nodes_are_the_sums_of_their_rows():
    alpha, gamma, _ = matrices()
    np.testing.assert_allclose(alpha.sum(axis=1), RODAS4.alpha, atol=CONDITION)
    np.testing.assert_allclose(gamma.sum(axis=1), RODAS4.d, atol=CONDITION)
    np.testing.assert_allclose(np.diag(gamma), GAMMA, atol=CONDITION)


def test_order_conditions_of_order_four_hold():
    """Hairer & Wanner II, table 7.1, with beta = alpha + gamma in full."""
    alpha, gamma, b = matrices()
    beta, nodes, one = alpha + gamma, alpha.sum(axis=1), np.ones(6)
    reach = beta @ one
    wanted = {
        1.0: b @ one,
        1 / 2: b @ reach,
        1 / 3: b @ nodes**2,
        1 / 6: b @ beta @ reach,
        1 / 4: b @ nodes**3,
        1 / 8: b @ (nodes * (alpha @ reach)),
        1 / 12: b @ beta @ nodes**2,
        1 / 24: b @ beta @ beta @ reach,
    }
    for value, sum_of_weights in wanted.items():
        assert abs(sum_of_weights - value) < CONDITION
    assert abs(b @ beta @ beta @ beta @ reach - 1 / 120) > 1e-6  # it is not of order 5


def test_the_embedded_solution_is_of_order_three_only():
    """It is the argument of the last stage, so that the estimate is the last u."""
    alpha, gamma, _ = matrices()
    b, nodes, beta = alpha[5], alpha.sum(axis=1), alpha + gamma
    reach = beta.sum(axis=1)
    for value, got in (
        (1.0, b.sum()),
        (1 / 2, b @ reach),
        (1 / 3, b @ nodes**2),
        (1 / 6, b @ beta @ reach),
    ):
        assert abs(got - value) < CONDITION
    assert abs(b @ nodes**3 - 1 / 4) > 1e-6


def stability(z):
    """R(z) = 1 + z b (I - z B)^-1 1, in 50 digits."""
    alpha, gamma, b = matrices()
    beta = mpmath.matrix((alpha + gamma).tolist())
    solved = mpmath.lu_solve(mpmath.eye(6) - z * beta, mpmath.ones(6, 1))
    return 1 + z * sum(mpmath.mpf(float(b[i])) * solved[i] for i in range(6))


def test_it_is_a_stable_and_its_stability_function_vanishes_at_infinity():
    with mpmath.workdps(50):
        for exponent in range(-3, 9):
            assert abs(stability(mpmath.mpc(0, 10.0**exponent))) <= 1 + 1e-12
        # What is left is the rounding of the coefficients to 16 digits.
        assert abs(stability(mpmath.mpf(-1e12))) < 1e-10
        assert abs(stability(mpmath.mpc(-1e12, 1e12))) < 1e-10


def test_the_stability_function_is_the_exponential_up_to_order_four():
    with mpmath.workdps(50):
        for z in (mpmath.mpf("1e-3"), mpmath.mpc(0, "1e-3")):
            miss = abs(stability(z) - mpmath.exp(z))
            assert 1e-3 * 1e-15 < miss < 1e-15


@pytest.mark.parametrize("rate", [1.0, 1e3, 1e6, 1e9])
def test_one_step_of_the_code_on_the_linear_test_equation_is_its_stability_function(rate):
    with mpmath.workdps(30):
        wanted = float(stability(mpmath.mpf(-0.5 * rate)).real)
    got, _ = steps_of(1.0, 0.5, 1, lambda y: -rate, lambda t, y: -rate * y)
    assert got == pytest.approx(wanted, abs=1e-13)
    assert abs(got) < 1.0


def test_a_stiff_equation_follows_its_slow_solution_in_large_steps():
    """Prothero & Robinson: y' = -1e6 (y - cos t) - sin t from y(0) = 1; y = cos t."""
    rate = 1e6
    got, _ = steps_of(
        1.0,
        0.05,
        20,
        lambda y: -rate,
        lambda t, y: -rate * (y - math.cos(t)) - math.sin(t),
        lambda t: -rate * math.sin(t) - math.cos(t),
    )
    assert got == pytest.approx(math.cos(1.0), abs=1e-9)
