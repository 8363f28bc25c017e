# SPDX-License-Identifier: Apache-2.0
"""A picture that the disk has no room for is an OSError, whatever matplotlib makes of it."""

import errno
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
from pathlib import Path
from matplotlib.figure import Figure
from sst_ros.plot.style import save_figure

figure = Figure()
figure.subplots().plot(range(3000), [i * i % 97 for i in range(3000)])
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
try:
    save_figure(figure, Path(sys.argv[1]))
except OSError as error:
    print(error.errno)
"""


@pytest.mark.parametrize("form", ["pdf", "png", "svg"])
def test_a_picture_on_a_full_disk(form, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, tmp_path / f"picture.{form}"],
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert done.stdout == f"{errno.EFBIG}\n", done.stderr
    assert done.stderr == ""
