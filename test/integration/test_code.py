# SPDX-License-Identifier: Apache-2.0
"""Machine code before it is needed: made once, found by others, one maker at a time."""

from __future__ import annotations

import fcntl
from dataclasses import replace

import pytest

from sst_ros.integration import codegen, compiled_method
from sst_ros.scene.scene import Inertia, Initial, load

pytestmark = pytest.mark.skipif(codegen.numba_version() is None, reason="numba is missing")
EXAMPLE1 = load("example1")


def test_code_is_made_once_and_found(tmp_path, monkeypatch):
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path / "cache"))
    assert not compiled_method.code_is_there(EXAMPLE1, "rk4")
    assert list(compiled_method.make_code(EXAMPLE1, "rk4")) == ["rk4"]
    assert compiled_method.code_is_there(EXAMPLE1, "rk4")
    assert not compiled_method.code_is_there(EXAMPLE1, "auto")
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*.nb[ic]")}
    assert list(compiled_method.make_code(EXAMPLE1, "rk4")) == ["rk4"]
    assert files == {path: path.stat().st_mtime_ns for path in files}
    # Neither where a run starts nor the numbers of its scene are part of its code.
    heavier = replace(EXAMPLE1.star, inertia=Inertia(xx=0.03, yy=0.04, zz=0.05))
    for other in ({"initial": Initial(gamma=(0.7, 0.8, 0.9))}, {"star": heavier}):
        assert compiled_method.code_is_there(replace(EXAMPLE1, **other), "rk4")
    assert not compiled_method.code_is_there(load("friction"), "rk4")


def test_one_process_makes_code_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path))
    with (tmp_path / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert list(compiled_method.make_code(EXAMPLE1, "rk4")) == []
    assert not compiled_method.code_is_there(EXAMPLE1, "rk4")


def test_without_numba_there_is_no_code(monkeypatch):
    monkeypatch.setenv("SST_ROS_NUMBA", "0")
    assert not compiled_method.code_is_there(EXAMPLE1, "rk4")
