# SPDX-License-Identifier: Apache-2.0
"""The package, a plain run and the list of scenes load nothing slow to import."""

import pytest
from programs import python
from slow_cases import slow_after

HEAVY = {
    "scipy",
    "matplotlib",
    "llvmlite",
    "numba",
    "rclpy",
    "pandas",
    "rosbags",
    "dask",
}
DOCUMENTS = {
    "cli",
    "description",
    "dynamics",
    "mechanism",
    "nodes",
    "programs",
    "runtime",
    "scene",
}
"""Rooms that a command needs which prints documents; of `nodes` and `runtime` only how
signals and child processes are handled.
"""
COMMAND = "from sst_ros.__main__ import main; main({!r})"
RUN = "import sst_ros; sst_ros.Simulation('example2').step((1.0, 0.0, 0.0), 10_000_000)"


@pytest.mark.parametrize(
    ("program", "rooms", "excluded"),
    [
        pytest.param("import sst_ros", set(), HEAVY | {"numpy", "yaml"}, id="package"),
        pytest.param(RUN, None, HEAVY - {"llvmlite"}, id="a run"),
        pytest.param(
            COMMAND.format(["scene", "list"]), DOCUMENTS, HEAVY, id="scene list"
        ),
        pytest.param(
            COMMAND.format(["scene", "schema"]), DOCUMENTS, HEAVY, id="scene schema"
        ),
        pytest.param(COMMAND.format(["describe"]), DOCUMENTS, HEAVY, id="describe"),
    ],
)
def test_what_is_loaded(program, rooms, excluded):
    """A command takes little more time than the import of NumPy: it loads what it
    needs.
    """
    done = python(f"{program}\nimport sys\nprint(*sys.modules)")
    names = [name.split(".") for name in done.stdout.splitlines()[-1].split()]
    assert ["sst_ros"] in names and not {first for first, *_ in names} & excluded
    if rooms is not None:
        assert {
            name[1] for name in names if name[0] == "sst_ros" and len(name) > 2
        } <= rooms
        assert ["sst_ros", "dynamics", "kernel"] not in names


STEPS = """
import sys
from sst_ros import Simulation
from sst_ros.errors import RunStopped
simulation = Simulation("{scene}")
simulation.load_code()
before = set(sys.modules)
try:
    simulation.steps(({torque}, 0.0, 0.0), 1_000_000, 2000)
except RunStopped as stopped:
    print(stopped)
assert simulation.time_ns > 100_000_000
print(*sorted(set(sys.modules) - before))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "torque"),
    slow_after(1, [("example2_heavy", 50.0), ("elastic_stops", 1.0)]),
)
def test_steps_import_nothing_after_the_code_is_loaded(scene, torque):
    """A limit or a stop met by a run in real time costs no import: it takes 0.4 s."""
    done = python(STEPS.format(scene=scene, torque=torque))
    assert done.stdout.splitlines()[-1] == ""
