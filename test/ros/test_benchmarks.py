# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of the nodes that are run by hand still run, for seconds."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.slow]
ROOT = Path(__file__).parents[2]


def printed(name, *words):
    """Return what a benchmark prints; it has a ROS domain of its own."""
    argv = [sys.executable, "-m", f"benchmark.{name}", *words]
    done = subprocess.run(argv, cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def rows(text):
    """Cells of the tables, by the first cell of each row."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: others for first, *others in cells}


def test_realtime():
    pytest.importorskip("llvmlite", reason="what is measured is compiled")
    found = rows(printed("realtime", "--minutes", "0.05", "--rounds", "0"))
    for recorded in found["recorded"]:
        one, other = map(int, re.findall(r"\d+", recorded))
        assert one == other > 1000
    assert len(found["missed ticks, times those of the loop"]) == 3
    factors = [float(factor) for factor in found["real-time factor"]]
    assert len(factors) == 5 and min(factors) > 1.0
    assert found["simulators"] == ["10"]


def test_bare_loops():
    pytest.importorskip("llvmlite", reason="what is measured is compiled")
    tables = (
        printed("bare_loops", "--seconds", "1", "--rounds", "1").strip().split("\n\n")
    )
    assert len(tables) == 2
    for text in tables:
        if "not permitted" not in text:
            _, _, *measured = (found := rows(text)).values()
            assert found["and looks for commands on 2 topics"][2] == "1.00"
            assert len(measured) == 6 and all(
                float(cells[0]) > 0.0 for cells in measured
            )


@pytest.mark.timeout(400)
def test_soak():
    """Growth counts after the first minute: until then the heap of the recorder still
    settles.
    """
    pytest.importorskip("viser", reason="what is soaked has a viewer")
    said = printed("soak", "--minutes", "1.5")
    assert "missing 0\n" in said and "WRONG" not in said
