# SPDX-License-Identifier: Apache-2.0
"""Long runs: the work that a report does for them, which is what its time and memory come from."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from sst_ros.integration.propagator import TickPropagator
from sst_ros.recording import recording
from sst_ros.report import reference, timing
from sst_ros.report.run import report

ROOT = str(Path(__file__).parents[2])


@pytest.fixture(scope="module")
def long_bag():
    """Import benchmark/long_bag.py, which is not part of the package."""
    pytest.importorskip("numba")
    sys.path.insert(0, ROOT)
    yield importlib.import_module("benchmark.long_bag")
    sys.path.remove(ROOT)


@pytest.fixture(scope="module")
def written(long_bag, tmp_path_factory):
    return long_bag.write(tmp_path_factory.mktemp("long") / "bag", 20.0)


def test_a_long_run_is_integrated_compiled(written, monkeypatch):
    calls = 0
    follow = TickPropagator.follow

    def counted(*given):
        nonlocal calls
        calls += 1
        return follow(*given)

    run = recording.read(written)
    assert len(run.time_ns) == 10_001 and len(run.ticks.start_ns) == 20_000
    monkeypatch.setattr(TickPropagator, "follow", counted)
    integration, ideal = reference.integration(run), reference.ideal(run)
    energy = timing.energy_residual(run, [])
    assert calls == 3  # both references and the energy, in one call each
    assert integration.compared == 10_001 and integration.error.gamma.max() < 1e-12
    assert integration.own.gamma.max() < 1e-13 and ideal.error.gamma.max() < 1e-2
    assert np.abs(energy).max() < 1e-11


def test_compiled_and_plain_tell_the_same(written, monkeypatch):
    run = recording.read(written)
    compiled = reference.integration(run), timing.energy_residual(run, [])
    monkeypatch.setenv("SST_ROS_NUMBA", "0")
    monkeypatch.setattr(reference, "PLAIN_TICKS", 400)
    monkeypatch.setattr(timing, "PLAIN_TICKS", 400)
    missing = []
    plain = reference.integration(run), timing.energy_residual(run, missing)
    assert plain[0].compared == 201
    assert plain[0].reasons == ("only the first 0.4 s are compared: there is no numba for more",)
    assert "there is no numba" in missing[0] and np.isfinite(plain[1]).sum() == 201
    assert plain[0].error.gamma[:201] == pytest.approx(compiled[0].error.gamma[:201], abs=1e-15)
    assert plain[1][:201] == pytest.approx(compiled[1][:201], abs=1e-13)


@pytest.mark.slow
def test_a_minute_is_reported_whole(long_bag, tmp_path):
    summary = report(long_bag.write(tmp_path / "bag", 60.0), tmp_path / "out")
    assert summary["samples_recorded"] == summary["samples_compared"] == 30_001
    assert summary["integration_error_gamma_rad"] < 1e-12
    assert summary["commands_followed"] == 30_000
    assert summary["command_latency_mean_us"] == pytest.approx(750.0)
