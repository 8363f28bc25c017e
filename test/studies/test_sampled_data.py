# SPDX-License-Identifier: Apache-2.0
"""What theory says of sampled loops, held against other forms of the same theory."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import cont2discrete

from studies.sampled_data import largest_stable, pole, slope, stability_limit


def matrix(product, damping, delay):
    """The loop in state space: a double integrator sampled by scipy, and a line of delays."""
    a, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    a, b, *_ = cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), 1.0)
    gain = -np.array([product**2, 2.0 * damping * product])
    if delay == 0:
        return a + b @ gain[None, :]
    whole = np.zeros((2 + delay, 2 + delay))
    whole[:2, :2], whole[:2, 2:3] = a, b
    whole[2:-1, 3:] = np.eye(delay - 1)
    whole[-1, :2] = gain
    return whole


@pytest.mark.parametrize("delay", range(6))
@pytest.mark.parametrize("damping", [0.3, 0.7, 1.0, 2.0])
def test_the_poles_are_the_eigenvalues_of_the_sampled_loop(damping, delay):
    for product in (0.01, 0.1, 0.5, 1.5):
        expected = np.abs(np.linalg.eigvals(matrix(product, damping, delay))).max()
        assert pole(product, damping, delay) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("damping", [0.1, 0.4, 0.5, 0.7, 1.0, 3.0])
def test_without_delay_the_limit_is_that_of_jury(damping):
    assert stability_limit(damping, 0) == pytest.approx(min(4.0 * damping, 1.0 / damping), rel=3e-6)


@pytest.mark.parametrize("damping", [0.5, 1.0])
def test_with_long_delay_the_limit_is_that_of_continuous_time(damping):
    """A hold and d samples are a delay of (d + 1/2) T: the phase margin over the crossover."""

    def gain(x):
        return np.hypot(1.0, 2.0 * damping * x) - x * x

    x = brentq(gain, 0.5, 10.0)
    margin = np.arctan(2.0 * damping * x) / x
    assert stability_limit(damping, 30) * 30.5 == pytest.approx(margin, rel=1e-3)


@pytest.mark.parametrize("delay", range(6))
def test_every_bandwidth_below_the_limit_is_stable_and_none_above(delay):
    limit = stability_limit(1.0, delay)
    assert all(pole(share * limit, 1.0, delay) < 1.0 for share in np.linspace(0.001, 0.999, 500))
    assert all(pole(share * limit, 1.0, delay) > 1.0 for share in np.linspace(1.001, 5.0, 500))


def test_a_limit_is_found_and_nan_where_nothing_is_stable():
    assert largest_stable(lambda x: x < 3.7, 1.0, 1.3, 1e-4) == pytest.approx(3.7, rel=1e-4)
    assert np.isnan(largest_stable(lambda x: False, 1.0, 1.3))


def test_a_slope_is_the_power():
    periods = [1.0, 2.0, 4.0]
    assert slope(periods, [3.0 * h**1.5 for h in periods]) == pytest.approx(1.5)
