# SPDX-License-Identifier: Apache-2.0
"""Each benchmark that is run by hand still runs, on little work."""

import importlib
import shutil

import pytest

RUNS = {
    "kernel": ("--rounds", "1"),
    "batch": ("--scenarios", "200", "--rounds", "1"),
}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc")
@pytest.mark.parametrize("name", RUNS)
def test_a_benchmark_runs(name, capsys):
    pytest.importorskip("numba", reason="what is measured is compiled")
    assert importlib.import_module(f"benchmark.{name}").main([*RUNS[name]]) == 0
    assert "target" in capsys.readouterr().out
