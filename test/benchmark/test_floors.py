# SPDX-License-Identifier: Apache-2.0
"""Benchmarks that have a floor in C: they run, and C is the same program."""

import copy
import importlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

from benchmark import c_floor
from benchmark.batch import FLAGS, METHODS
from sst_ros.integration.batch import Batch, block_width
from sst_ros.integration.batch_step import Block, advance_blocks
from sst_ros.programs.llvm import LANES
from sst_ros.scene.scene import load

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc"),
]
RUNS = {"kernel": ("--rounds", "1"), "batch": ("--scenarios", "200", "--rounds", "1")}


@pytest.mark.parametrize("name", RUNS)
def test_a_benchmark_runs(name, capsys, monkeypatch):
    pytest.importorskip("llvmlite", reason="what is measured is compiled")
    # gcc takes 18 s longer for DOP853
    monkeypatch.setattr("benchmark.batch.METHODS", {"rk4": METHODS["rk4"]})
    assert importlib.import_module(f"benchmark.{name}").main([*RUNS[name]]) == 0
    assert "target" in capsys.readouterr().out


def test_a_batch_in_c_without_fused_operations_has_the_same_bits(tmp_path):
    number = 4 * LANES + 3
    scene, method = load("example2_heavy"), METHODS["rk4"]
    batch = Batch(scene, method, profile=True)
    gamma = np.array(scene.initial.gamma) + np.linspace(-0.05, 0.05, number)[:, None]
    y, code = batch.initial(gamma, (0.0, 0.0, 0.0))
    given = batch.drives((0.0, 0.0, 0.0), number)
    in_c = copy.copy(batch.programs)
    flags = FLAGS["C SIMD, no fma"]
    program = batch.programs.traced["advance"]
    in_c.advance = c_floor.RowsInC(program, 2, tmp_path, "batch", *flags)
    assert in_c.advance.vectorised
    sets = [
        [y.copy(), given, code.copy(), np.full(number, np.nan), np.zeros(number)]
        for _ in range(2)
    ]
    batch.advance(0, 50, 2e-3, *sets[0])
    width = block_width(number)
    advance_blocks(Block(in_c, width), range(0, number, width), 0, 50, 2e-3, *sets[1])
    for one, other in zip(*sets, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(sets[0][0], y)


SMALLEST = """
import sys
from pathlib import Path
from benchmark.c_floor import compile_c
compile_c("double half(double x) { return 0.5 * x; }", Path(sys.argv[1]), "half",
          "-O3", "-ffast-math")
assert 0.5 * sys.float_info.min > 0.0
"""


def test_fast_mathematics_in_c_leaves_the_processors_mode(tmp_path):
    command = [sys.executable, "-c", SMALLEST, str(tmp_path)]
    subprocess.run(command, check=True, timeout=60)
