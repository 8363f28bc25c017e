# SPDX-License-Identifier: Apache-2.0
"""Compiled code and its cache: made once by one maker, shared, repaired, done without."""

from __future__ import annotations

import fcntl
import os
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from loaded_scenes import IGNORE
from programs import python

from sst_ros.host import compiled_module
from sst_ros.integration.compiled_method import code_is_there, make_code
from sst_ros.scene.bodies import Inertia
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import load
from sst_ros.simulation import simulate_gauss
from sst_ros.simulation.simulate import simulate
from sst_ros.simulation.simulation import Simulation

MILLISECOND = 1_000_000
SOURCE = """\
from sst_ros.scene.scene import load
from sst_ros.simulation.simulation import Simulation
simulation = Simulation(load("example1"), "rk4", compiled=True)
print(simulation.step((1.0, 2.0, 3.0), 1_000_000).quaternion, simulation.compiled)
"""
needs_numba = pytest.mark.skipif(compiled_module.numba_version() is None, reason="numba is missing")


EXAMPLE1, EXAMPLE2 = load("example1"), replace(load("example2_heavy"), **IGNORE)


def heavier(scene):
    return replace(scene, star=replace(scene.star, inertia=Inertia(xx=0.03, yy=0.04, zz=0.05)))


def files_of(folder):
    """Files of code, and when they were written."""
    kinds = (".py", ".nbi", ".nbc")
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.suffix in kinds}


@needs_numba
def test_code_is_made_once_found_and_shared_by_what_differs_in_numbers(tmp_path, monkeypatch):
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    assert not code_is_there(EXAMPLE1, "rk4")
    make_code(EXAMPLE1, "rk4")
    assert code_is_there(EXAMPLE1, "rk4")
    assert not code_is_there(EXAMPLE1, "auto")
    files = files_of(tmp_path)
    make_code(EXAMPLE1, "rk4")
    assert files
    # Neither where a run starts nor the numbers of its scene are part of its code.
    others = [replace(EXAMPLE1, initial=Initial(gamma=(0.7, 0.8, 0.9))), heavier(EXAMPLE1)]
    ends = set()
    for scene in (EXAMPLE1, *others):
        assert code_is_there(scene, "rk4")
        fast, plain = (Simulation(scene, "rk4", compiled=compiled) for compiled in (True, False))
        found, expected = (one.step((3.0, -2.0, 1.0), MILLISECOND) for one in (fast, plain))
        assert fast.compiled and found == expected
        ends.add(found.body_rate)
    assert len(ends) == 3
    assert files_of(tmp_path) == files
    assert not code_is_there(load("friction"), "rk4")


@needs_numba
def test_one_process_makes_code_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        make_code(EXAMPLE1, "rk4")
    assert not code_is_there(EXAMPLE1, "rk4")


@needs_numba
@pytest.mark.slow
def test_collocation_of_another_inertia_needs_no_compilation(tmp_path, monkeypatch):
    """Under `auto` it has the digits of plain Python."""
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    monkeypatch.setattr(simulate_gauss, "_WORTH_COMPILING", 0)
    monkeypatch.setattr(simulate_gauss, "_WORTH_LOADING", 0)
    made = None
    for scene in (EXAMPLE2, heavier(EXAMPLE2)):
        monkeypatch.delenv("SST_ROS_NUMBA", raising=False)
        fast = simulate(scene, duration=0.1, method="gauss").quaternion
        both = []
        for numba in ("1", "0"):
            monkeypatch.setenv("SST_ROS_NUMBA", numba)
            simulate_gauss._collocation.cache_clear()
            both.append(simulate(scene, duration=0.1).quaternion)
        assert both[0].tobytes() == both[1].tobytes()
        np.testing.assert_allclose(fast, both[0], rtol=0, atol=1e-13)
        made = made or files_of(tmp_path)
    assert len(made) >= 6 and files_of(tmp_path) == made


def run_with(cache):
    return python(SOURCE, env={"SST_ROS_CACHE": str(cache)}).stdout.strip()


@pytest.fixture(scope="module")
def truth():
    simulation = Simulation(load("example1"), "rk4")
    return str(simulation.step((1.0, 2.0, 3.0), MILLISECOND).quaternion)


@pytest.fixture(scope="module")
def cache(tmp_path_factory, truth):
    """A cache that two processes have filled at once."""
    folder = tmp_path_factory.mktemp("cache")
    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(run_with, [folder] * 2)] == [f"{truth} True"] * 2
    return folder


@needs_numba
@pytest.mark.slow
def test_two_processes_that_start_at_once_share_one_cache_and_a_third_compiles_nothing(
    cache, truth
):
    assert len(list(cache.glob("sst_*.py"))) == 2  # what all methods call, and a method
    assert {path.suffix for path in cache.iterdir()} == {".py", ""}
    before = files_of(cache)
    assert {path.suffix for path in before} == {".py", ".nbi", ".nbc"}
    assert run_with(cache) == f"{truth} True"
    assert files_of(cache) == before


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
    assert run_with(cache) == f"{truth} True"
    assert all(path.stat().st_size > 40 for path in files)


@needs_numba
@pytest.mark.slow
def test_a_folder_that_cannot_be_written_means_compiling_anew(tmp_path, truth):
    """A file stands where the folder should be: that stops root too."""
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert run_with(blocked / "cache") == f"{truth} True"


@pytest.mark.parametrize("missing", ["switched off", "not installed"])
def test_without_numba_plain_python_runs_and_says_so_to_who_asked(missing, monkeypatch, truth):
    if missing == "switched off":
        monkeypatch.setenv("SST_ROS_NUMBA", "0")
    else:
        monkeypatch.setitem(sys.modules, "numba", None)
    assert compiled_module.numba_version() is None
    assert not code_is_there(EXAMPLE1, "rk4")
    said = "no numba(.|\n)*running plain Python, slower, the same digits"
    with pytest.warns(RuntimeWarning, match=said):
        asked = Simulation(EXAMPLE1, "rk4", compiled=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        unasked = Simulation(EXAMPLE1, "rk4")
        for one in (asked, unasked):
            assert not one.compiled
            assert str(one.step((1.0, 2.0, 3.0), MILLISECOND).quaternion) == truth
