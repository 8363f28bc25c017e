# SPDX-License-Identifier: Apache-2.0
"""Sampled loops: models that are wrong, encoders, noise and delays, and the theory of
stability.
"""

import numpy as np
import pytest
from scipy.signal import cont2discrete

from sst_ros.control.controller import Measurement
from sst_ros.control.law import ControlChannel
from sst_ros.scene.scene import load
from studies.control_loop import ChannelState, model_errors
from studies.sampled_data import largest_stable, pole, stability_limit

REACH, EXAMPLE2 = load("reach"), load("example2_heavy")


@pytest.mark.parametrize(
    ("plant", "without"),
    [
        (REACH, ["nominal"]),
        (EXAMPLE2, ["nominal", "friction unknown", "gravity missing"]),
    ],
)
def test_every_error_is_one_but_of_what_the_plant_has_not(plant, without):
    errors = list(model_errors())
    assert [error.name for error in errors if not error.changes(plant)] == without
    assert len({error.name for error in errors}) == len(errors)


@pytest.mark.parametrize("error", list(model_errors()), ids=lambda error: error.name)
def test_an_error_keeps_the_motion(error):
    model = error.model(REACH)
    kept = ("base", "initial", "motion", "stroke", "workspace")
    assert all(getattr(model, key) == getattr(REACH, key) for key in kept)


GAMMA, RATE = (0.7, 0.8, 0.9), (0.1, -0.2, 0.3)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_commands_are_late_by_whole_samples_and_the_first_waits(delay):
    wire = ChannelState(ControlChannel(delay=delay), 0)
    assert wire.measure(GAMMA, RATE) == Measurement(GAMMA, RATE)
    came = [wire.transmit((float(k), 0.0, 0.0))[0] for k in range(10)]
    assert came == [max(k - delay, 0) for k in range(10)]


def test_an_encoder_counts_and_knows_rates_from_counts_alone():
    period, counts = 1e-3, 1000
    step = 2.0 * np.pi / counts
    wire = ChannelState(ControlChannel(period=period, counts=counts), 0)
    seen, rates = [], []
    for k in range(200):
        angle = 0.5 + 3.0 * k * period
        measured = wire.measure((angle,) * 3, (3.0,) * 3)
        gamma, rate = measured.gamma, measured.gamma_dot
        assert abs(gamma[0] - angle) <= 0.5 * step * (1.0 + 1e-9)
        assert gamma[0] / step == pytest.approx(round(gamma[0] / step), abs=1e-9)
        seen.append(gamma[0])
        rates.append(rate[0])
    np.testing.assert_allclose(rates[1:], np.diff(seen) / period, atol=1e-9)
    assert np.mean(rates) == pytest.approx(3.0, abs=step / (200 * period))


def test_noise_has_its_deviation_and_repeats_by_seed():
    def drawn(seed):
        wire = ChannelState(ControlChannel(angle_noise=1e-3, rate_noise=0.1), seed)
        seen = (wire.measure(GAMMA, RATE) for _ in range(4000))
        return np.array([(one.gamma, one.gamma_dot) for one in seen])

    first = drawn(3)
    # The deviation of 12 000 numbers is known to 1 / sqrt(2 n) = 0.65 %.
    assert np.std(first[:, 0] - GAMMA) == pytest.approx(1e-3, rel=0.03)
    assert np.std(first[:, 1] - RATE) == pytest.approx(0.1, rel=0.03)
    assert np.array_equal(first, drawn(3))
    assert not np.array_equal(first, drawn(4))


def matrix(product, damping, delay):
    """The loop in state space: a double integrator sampled by scipy, and a line of
    delays.
    """
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
    assert stability_limit(damping, 0) == pytest.approx(
        min(4.0 * damping, 1.0 / damping), rel=3e-6
    )


@pytest.mark.parametrize("delay", range(6))
def test_bandwidths_below_the_limit_are_stable_and_none_above(delay):
    limit = stability_limit(1.0, delay)
    assert all(
        pole(share * limit, 1.0, delay) < 1.0
        for share in np.linspace(0.001, 0.999, 500)
    )
    assert all(
        pole(share * limit, 1.0, delay) > 1.0 for share in np.linspace(1.001, 5.0, 500)
    )


def test_a_limit_is_found_and_nan_where_nothing_is_stable():
    assert largest_stable(lambda x: x < 3.7, 1.0, 1.3, 1e-4) == pytest.approx(
        3.7, rel=1e-4
    )
    assert np.isnan(largest_stable(lambda x: False, 1.0, 1.3))
