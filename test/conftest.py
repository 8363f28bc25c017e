# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all rooms: a run of Example 2, as messages and as a recording."""

import importlib.util
import sys
from pathlib import Path

import pytest

from sst_ros import scene
from sst_ros.dynamics import kernel, traced_dynamics

# bags.py is loaded by its path: as `report.bags` it would need a package test/report.
_SPEC = importlib.util.spec_from_file_location(
    "sst_ros_test_bags", Path(__file__).parent / "report" / "bags.py"
)
_BAGS = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = _BAGS
_SPEC.loader.exec_module(_BAGS)


@pytest.fixture(scope="session")
def bags():
    return _BAGS


@pytest.fixture(scope="session")
def example2():
    """Messages of 0.3 s of Example 2."""
    return _BAGS.simulated(scene.load("example2"), 0.3)


@pytest.fixture
def written(tmp_path, bags):
    """Write messages and return the path of the bag."""

    def write(entries, **options):
        return bags.write(tmp_path / "bag", entries, **options)

    return write


@pytest.fixture
def wrong_kernel(monkeypatch):
    """Falsify what the kernel's derivative gives, and what has been traced from it or will be."""
    right = kernel.derivative

    def put(wrong):
        monkeypatch.setattr(kernel, "derivative", lambda *given: wrong(right(*given)))
        traced_dynamics.recent.cache_clear()

    yield put
    traced_dynamics.recent.cache_clear()
