# SPDX-License-Identifier: Apache-2.0
"""Long curves keep all that a picture could show; a picture that finds no room is an OSError."""

import errno
import subprocess
import sys

import numpy as np

from sst_ros.plot import style

COUNT = 300_000


def test_few_points_stay_and_every_spike_is_among_them():
    generator = np.random.default_rng(4)
    curves = generator.normal(size=(3, COUNT))
    spikes = generator.choice(COUNT, 40, replace=False)
    curves[np.arange(40) % 3, spikes] = 20.0 * (-1.0) ** np.arange(40)
    rows = style.envelope(curves, COUNT)
    assert len(rows) < 3 * 2 * style.STRETCHES + 10 and np.all(np.diff(rows) > 0)
    assert set(spikes) <= set(rows) and {0, COUNT - 1} <= set(rows)
    size = -(-COUNT // style.STRETCHES)
    for curve in curves:  # the envelope is that of the whole curve
        for begin in range(0, COUNT, 50 * size):
            stretch = slice(begin, begin + size)
            few = curve[rows[(rows >= begin) & (rows < begin + size)]]
            assert (few.min(), few.max()) == (curve[stretch].min(), curve[stretch].max())


def test_a_gap_stays_a_gap():
    curve = np.sin(np.arange(COUNT) / 1e4)
    curve[123_456] = np.nan
    curve[200_000:220_000] = np.nan
    rows = style.envelope([curve], COUNT)
    assert 123_456 in rows and np.isnan(curve[rows]).sum() > 10


def test_short_curves_are_left_alone():
    assert np.array_equal(style.envelope([np.zeros(1000)], 1000), np.arange(1000))


PROGRAM = """
import resource, sys
from pathlib import Path
from matplotlib.figure import Figure
from sst_ros.plot.style import save_figure

figure = Figure()
figure.subplots().plot(range(3000), [i * i % 97 for i in range(3000)])
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
for form in ("pdf", "png", "svg"):
    try:
        save_figure(figure, Path(sys.argv[1]) / f"picture.{form}")
    except OSError as error:
        print(error.errno)
"""


def test_a_picture_on_a_full_disk(tmp_path):
    command = [sys.executable, "-c", PROGRAM, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == (3 * f"{errno.EFBIG}\n", "")
