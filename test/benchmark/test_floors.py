# SPDX-License-Identifier: Apache-2.0
"""Benchmarks that have a floor in C: they run, and C is the same program."""

import importlib
import shutil

import numpy as np
import pytest

from benchmark import c_floor
from benchmark.batch import FLAGS, METHODS
from sst_ros.integration.batch import Batch
from sst_ros.integration.simd_source import SIMD_WIDTH
from sst_ros.scene.scene import load

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")]
RUNS = {"kernel": ("--rounds", "1"), "batch": ("--scenarios", "200", "--rounds", "1")}


@pytest.mark.parametrize("name", RUNS)
def test_a_benchmark_runs(name, capsys):
    pytest.importorskip("numba", reason="what is measured is compiled")
    assert importlib.import_module(f"benchmark.{name}").main([*RUNS[name]]) == 0
    assert "target" in capsys.readouterr().out


def test_a_batch_in_c_has_the_bits_of_numba_where_it_may_not_fuse(tmp_path, monkeypatch):
    pytest.importorskip("numba", reason="a batch needs numba")
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    number = SIMD_WIDTH + 3
    scene, method = load("example2_heavy"), METHODS["rk4"]
    batch = Batch(scene, method, profile=True)
    gamma = np.array(scene.initial.gamma) + np.linspace(-0.05, 0.05, number)[:, None]
    y, code = batch.start(gamma, (0.0, 0.0, 0.0))
    given = batch.drives((0.0, 0.0, 0.0), number)
    text, _ = c_floor.write_batch(
        batch.model.program, batch.model.limit_distances, method, len(batch.model.ode.state)
    )
    library, vectorised = c_floor.compile_batch(text, tmp_path, "batch", *FLAGS["C SIMD, no fma"])
    assert vectorised > 0
    sets = [
        [y.copy(), given, code.copy(), np.full(number, np.nan), np.zeros(number)] for _ in range(2)
    ]
    batch.advance(0, 50, 2e-3, *sets[0])
    library.batch(2e-3, 0, 50, 0, 2, number, *(array.ctypes.data for array in sets[1]))
    for one, other in zip(*sets, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(sets[0][0], y)
