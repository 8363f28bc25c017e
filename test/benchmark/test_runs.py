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


@pytest.mark.slow
def test_the_measured_orders_and_the_energy_are_those_of_theory(capsys):
    pytest.importorskip("numba", reason="what is measured is compiled")
    assert importlib.import_module("benchmark.orders").main(["--seconds", "2"]) == 0
    said = capsys.readouterr().out
    assert said.count(": met") == 7 and "MISSED" not in said
