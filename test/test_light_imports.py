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
SCHEMA = """
from sst_ros.__main__ import main
main(["scene", "schema"])
"""
LOADED = """
import sys
print(*sys.modules)
"""
DOCUMENTS = {"cli", "description", "dynamics", "host", "mechanism", "nodes", "scene"}
"""Rooms that a command needs which prints documents; of `nodes` the handler of signals."""


@pytest.mark.parametrize("program", [RUN, LIST, SCHEMA])
def test_numpy_and_yaml_are_all_that_is_loaded(program):
    done = subprocess.run(
        [sys.executable, "-c", program + LOADED],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    loaded = done.stdout.splitlines()[-1].split()
    libraries = {name.split(".")[0] for name in loaded}
    assert "sst_ros" in libraries and not libraries & HEAVY
    if program is not RUN:
        rooms = {
            name.split(".")[1] for name in loaded if name.count(".") == 2 and "sst_ros." in name
        }
        assert rooms <= DOCUMENTS and "sst_ros.dynamics.kernel" not in loaded


STEPS = """
import sys
from sst_ros import Simulation
from sst_ros.errors import RunStopped
simulation = Simulation("{scene}", compiled=False)
simulation.load_code(1_000_000)
before = set(sys.modules)
try:
    simulation.steps(({torque}, 0.0, 0.0), 1_000_000, 2000)
except RunStopped as stopped:
    print(stopped)
assert simulation.time_ns > 100_000_000
print(*sorted(set(sys.modules) - before))
"""


@pytest.mark.parametrize(("scene", "torque"), [("example2_heavy", 50.0), ("elastic_stops", 1.0)])
def test_steps_import_nothing_after_the_code_is_loaded(scene, torque):
    """A limit or a stop that a run in real time meets costs no import: it takes 0.4 s."""
    done = subprocess.run(
        [sys.executable, "-c", STEPS.format(scene=scene, torque=torque)],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == ""
