# SPDX-License-Identifier: Apache-2.0
"""Encoders, noise and delays."""

import numpy as np
import pytest

from studies.control_loop import Channel, ChannelState

GAMMA, RATE = (0.7, 0.8, 0.9), (0.1, -0.2, 0.3)


def test_a_channel_that_loses_nothing_changes_nothing():
    wire = ChannelState(Channel(), 1e-3, 0)
    assert wire.measure(GAMMA, RATE) == (GAMMA, RATE)
    assert wire.delayed((1.0, 2.0, 3.0)) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_commands_come_late_by_whole_samples_and_the_first_one_waits(delay):
    wire = ChannelState(Channel(delay=delay), 1e-3, 0)
    came = [wire.delayed((float(k), 0.0, 0.0))[0] for k in range(10)]
    assert came == [max(k - delay, 0) for k in range(10)]


def test_an_encoder_counts_and_knows_rates_from_counts_alone():
    period, counts = 1e-3, 1000
    step = 2.0 * np.pi / counts
    wire = ChannelState(Channel(counts=counts), period, 0)
    seen, rates = [], []
    for k in range(200):
        angle = 0.5 + 3.0 * k * period
        gamma, rate = wire.measure((angle,) * 3, (3.0,) * 3)
        assert abs(gamma[0] - angle) <= 0.5 * step * (1.0 + 1e-9)
        assert gamma[0] / step == pytest.approx(round(gamma[0] / step), abs=1e-9)
        seen.append(gamma[0])
        rates.append(rate[0])
    np.testing.assert_allclose(rates[1:], np.diff(seen) / period, atol=1e-9)
    assert np.mean(rates) == pytest.approx(3.0, abs=step / (200 * period))


def test_noise_has_its_deviation_and_repeats_by_seed():
    def drawn(seed):
        wire = ChannelState(Channel(noise=(1e-3, 0.1)), 1e-3, seed)
        return np.array([wire.measure(GAMMA, RATE) for _ in range(4000)])

    first = drawn(3)
    # The deviation of 12 000 numbers is known to 1 / sqrt(2 n) = 0.65 %.
    assert np.std(first[:, 0] - GAMMA) == pytest.approx(1e-3, rel=0.03)
    assert np.std(first[:, 1] - RATE) == pytest.approx(0.1, rel=0.03)
    assert np.array_equal(first, drawn(3))
    assert not np.array_equal(first, drawn(4))
