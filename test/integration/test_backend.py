# SPDX-License-Identifier: Apache-2.0
"""Compiled code and its cache: shared, repaired, done without."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import pytest
from loaded_scenes import REST

from sst_ros.integration import codegen
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
SOURCE = """\
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation
simulation = Simulation(load("example1"), "rk4", compiled=True)
print(simulation.step((1.0, 2.0, 3.0), 1_000_000).quaternion, simulation.compiled)
"""
needs_numba = pytest.mark.skipif(codegen.numba_version() is None, reason="numba is missing")


def started(cache, **more):
    environment = {**os.environ, "SST_ROS_CACHE": str(cache), **more}
    return subprocess.Popen(
        [sys.executable, "-c", SOURCE],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process):
    out, err = process.communicate(timeout=100)
    assert process.returncode == 0, err
    return out.strip(), err


@pytest.fixture(scope="module")
def truth():
    simulation = Simulation(load("example1"), "rk4")
    return str(simulation.step((1.0, 2.0, 3.0), MILLISECOND).quaternion)


@pytest.fixture(scope="module")
def cache(tmp_path_factory, truth):
    """A cache that two processes have filled at once."""
    folder = tmp_path_factory.mktemp("cache")
    processes = [started(folder), started(folder)]
    for process in processes:
        assert ended(process)[0] == f"{truth} True"
    return folder


@needs_numba
@pytest.mark.slow
def test_two_processes_that_start_at_once_share_one_cache(cache):
    assert len(list(cache.glob("sst_*.py"))) == 2  # what all methods call, and a method
    assert {path.suffix for path in cache.iterdir()} == {".py", ""}
    assert list((cache / "__pycache__").glob("*.nbc"))


@needs_numba
@pytest.mark.slow
def test_a_second_process_compiles_nothing(cache, truth):
    before = {path: path.stat().st_mtime_ns for path in (cache / "__pycache__").glob("*.nb[ic]")}
    assert ended(started(cache))[0] == f"{truth} True"
    after = {path: path.stat().st_mtime_ns for path in (cache / "__pycache__").glob("*.nb[ic]")}
    assert before == after


def cut_off(cache, pattern, left):
    files = [*cache.glob(pattern), *(cache / "__pycache__").glob(pattern)]
    assert files
    for path in files:
        os.truncate(path, left)
    return files


@needs_numba
@pytest.mark.slow
@pytest.mark.parametrize("left", [40, 0])
def test_cut_off_files_are_repaired(left, cache, truth):
    """Source, index and machine code; at the end all can be loaded again."""
    files = [path for kind in ("sst_*.py", "*.nbi", "*.nbc") for path in cut_off(cache, kind, left)]
    assert ended(started(cache))[0] == f"{truth} True"
    assert all(path.stat().st_size > 40 for path in files)


@needs_numba
@pytest.mark.slow
def test_a_folder_that_cannot_be_written_means_compiling_anew(tmp_path, truth):
    """A file stands where the folder should be: that stops root too."""
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert ended(started(blocked / "cache"))[0] == f"{truth} True"


def test_without_numba_plain_python_runs_and_says_so(monkeypatch, truth):
    monkeypatch.setenv("SST_ROS_NUMBA", "0")
    with pytest.warns(RuntimeWarning, match="running plain Python, slower, the same digits"):
        simulation = Simulation(load("example1"), "rk4", compiled=True)
    assert not simulation.compiled
    assert str(simulation.step((1.0, 2.0, 3.0), MILLISECOND).quaternion) == truth


def test_a_numba_that_cannot_be_imported_is_none(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    assert codegen.numba_version() is None
    with pytest.warns(RuntimeWarning, match="no numba"):
        assert not Simulation(load("example1"), compiled=True).compiled


def test_who_does_not_ask_for_numba_is_not_warned(monkeypatch):
    monkeypatch.setenv("SST_ROS_NUMBA", "0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulation = Simulation(load("example1"))
        simulation.step(REST, MILLISECOND)
    assert not simulation.compiled
