# SPDX-License-Identifier: Apache-2.0
"""What is left out of pictures of long runs: nothing that a picture could show."""

import numpy as np

from sst_ros.plot import downsampling

COUNT = 300_000


def test_few_points_stay_and_every_spike_is_among_them():
    generator = np.random.default_rng(4)
    curves = generator.normal(size=(3, COUNT))
    spikes = generator.choice(COUNT, 40, replace=False)
    curves[np.arange(40) % 3, spikes] = 20.0 * (-1.0) ** np.arange(40)
    rows = downsampling.envelope(curves, COUNT)
    assert len(rows) < 3 * 2 * downsampling.STRETCHES + 10 and np.all(np.diff(rows) > 0)
    assert set(spikes) <= set(rows) and {0, COUNT - 1} <= set(rows)
    size = -(-COUNT // downsampling.STRETCHES)
    for curve in curves:  # the envelope is that of the whole curve
        for begin in range(0, COUNT, 50 * size):
            stretch = slice(begin, begin + size)
            few = curve[rows[(rows >= begin) & (rows < begin + size)]]
            assert (few.min(), few.max()) == (curve[stretch].min(), curve[stretch].max())


def test_a_gap_stays_a_gap():
    curve = np.sin(np.arange(COUNT) / 1e4)
    curve[123_456] = np.nan
    curve[200_000:220_000] = np.nan
    few = curve[downsampling.envelope([curve], COUNT)]
    assert np.isnan(few).sum() > 10
    rows = downsampling.envelope([curve], COUNT)
    assert 123_456 in rows


def test_short_curves_are_left_alone():
    assert np.array_equal(downsampling.envelope([np.zeros(1000)], 1000), np.arange(1000))
