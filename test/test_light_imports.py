# SPDX-License-Identifier: Apache-2.0
"""The package and a plain run load nothing that is slow to import."""

import subprocess
import sys

HEAVY = {"scipy", "matplotlib", "numba", "rclpy", "pandas"}
RUN = """
import sys
import sst_ros
simulation = sst_ros.Simulation("example2")
simulation.step((1.0, 0.0, 0.0), 10_000_000)
print(*{name.split(".")[0] for name in sys.modules})
"""


def test_a_plain_run_loads_numpy_and_yaml_only():
    done = subprocess.run(
        [sys.executable, "-c", RUN], capture_output=True, text=True, timeout=60, check=True
    )
    loaded = set(done.stdout.split())
    assert "sst_ros" in loaded and not loaded & HEAVY
