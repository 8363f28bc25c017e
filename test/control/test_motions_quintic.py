# SPDX-License-Identifier: Apache-2.0
"""Quintics through points against SciPy's splines and against the minimum they claim to be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from models import FAST
from scipy.interpolate import BPoly, make_interp_spline

from sst_ros.control.actuator_motions import Quintic, minimum_jerk

OPEN = np.nan


def points(seed, count=9):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.2, 1.0, count)), *rng.normal(size=(3, count, 2))


def sampled(quintic, times, part):
    return np.array([quintic.at(time)[part] for time in times.tolist()])


@pytest.mark.parametrize("seed", range(3))
def test_positions_alone_make_scipys_quintic_spline(seed):
    """Its system has a condition of some 1e4 for these intervals."""
    times, positions, velocities, accelerations = points(seed)
    velocities[1:-1] = accelerations[1:-1] = OPEN
    found = Quintic(times, positions, velocities, accelerations)
    ends = [[(1, velocities[i]), (2, accelerations[i])] for i in (0, -1)]
    truth = make_interp_spline(times, positions, k=5, bc_type=ends)
    fine = np.linspace(times[0], times[-1], 200)
    for part in range(3):
        expected = truth(fine, part)
        error = np.abs(sampled(found, fine, part) - expected).max()
        assert error <= 1e-12 * np.abs(expected).max()


def test_all_given_is_hermites_polynomial():
    times, *nodes = points(5)
    found = Quintic(times, *nodes)
    truth = BPoly.from_derivatives(times, np.stack(nodes, axis=1))
    fine = np.linspace(times[0], times[-1], 200)
    for part in range(3):
        expected = truth.derivative(part)(fine) if part else truth(fine)
        assert sampled(found, fine, part) == pytest.approx(
            expected, rel=1e-12, abs=1e-12 * np.abs(expected).max()
        )


def jerk_squared(times, nodes):
    """Integral of the jerk squared, by SciPy's polynomials and Gauss' rule, which is exact here."""
    jerk = BPoly.from_derivatives(times, nodes).derivative(3)
    x, weights = np.polynomial.legendre.leggauss(3)
    h = np.diff(times)[:, None]
    at = times[:-1, None] + 0.5 * h * (x + 1.0)
    return float(np.sum(0.5 * h * weights * np.sum(jerk(at) ** 2, axis=-1)))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_open_has_the_least_jerk(seed):
    """The integral is a quadratic of the open numbers: both its neighbours are equally above."""
    times, *given_nodes = points(seed, 6)
    nodes = np.stack(given_nodes, axis=1)
    rng = np.random.default_rng(seed)
    open_ = rng.random(nodes.shape) < 0.6
    open_[:, 0], open_[[0, -1]] = False, False
    found = Quintic(times, *np.where(open_, OPEN, nodes).transpose(1, 0, 2))
    filled = np.stack([sampled(found, times, part) for part in range(3)], axis=1)
    assert filled[~open_] == pytest.approx(nodes[~open_], abs=1e-10)
    assert open_.sum() > 5
    least = jerk_squared(times, filled)
    for index in np.argwhere(open_):
        step = np.zeros_like(filled)
        step[tuple(index)] = 0.1
        above = [jerk_squared(times, filled + sign * step) - least for sign in (-1.0, 1.0)]
        assert min(above) > 0.0
        assert above[0] == pytest.approx(above[1], abs=1e-9 * (least + above[0]))


@FAST
@given(st.floats(0.0, 1.0))
def test_minimum_jerk_is_its_polynomial(u):
    polynomial = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    expected = [polynomial(u), polynomial.deriv()(u), polynomial.deriv(2)(u)]
    assert minimum_jerk(u) == pytest.approx(expected, abs=2e-14)


def test_thousands_of_samples_are_completed_at_once():
    """A recording of 20 s at 1 kHz: the band is solved in one go."""
    times = np.arange(20_001) * 1e-3
    positions, velocities = (f(3.0 * times)[:, None] for f in (np.sin, lambda x: 3.0 * np.cos(x)))
    found = Quintic(times, positions, velocities, np.full_like(positions, OPEN))
    fine = np.linspace(1.0, 19.0, 501)
    assert sampled(found, fine, 2)[:, 0] == pytest.approx(-9.0 * np.sin(3.0 * fine), abs=1e-6)
