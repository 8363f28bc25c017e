# SPDX-License-Identifier: Apache-2.0
"""The package, a plain run and the list of scenes load nothing that is slow to import."""

import subprocess
import sys

import pytest

HEAVY = {"scipy", "matplotlib", "numba", "rclpy", "pandas"}
RUN = """
import sst_ros
simulation = sst_ros.Simulation("example2")
simulation.step((1.0, 0.0, 0.0), 10_000_000)
"""
LIST = """
from sst_ros.__main__ import main
main(["scene", "list"])
"""
LOADED = """
import sys
print(*{name.split(".")[0] for name in sys.modules})
"""


@pytest.mark.parametrize("program", [RUN, LIST])
def test_numpy_and_yaml_are_all_that_is_loaded(program):
    done = subprocess.run(
        [sys.executable, "-c", program + LOADED],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    loaded = set(done.stdout.splitlines()[-1].split())
    assert "sst_ros" in loaded and not loaded & HEAVY
