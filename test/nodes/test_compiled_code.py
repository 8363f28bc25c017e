# SPDX-License-Identifier: Apache-2.0
"""The process that compiles a scene for the next start: late, of low priority, one only."""

import fcntl
import sys
import time
from types import SimpleNamespace as Box

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
pytest.importorskip("numba", reason="needs numba: pip install .[fast]")

from sst_ros import load_scene
from sst_ros.nodes import simulator
from sst_ros.nodes.simulator import CodeCompiler
from sst_ros.runtime.settings import SimulatorParameters

FAKE = """#!{python}
import os, pathlib
here = pathlib.Path({folder!r})
with (here / "started").open("a") as file:
    file.write(f"{{os.nice(0)}}\\n")
"""


class Node:
    """Keeps timers and log lines."""

    def __init__(self):
        self.timers, self.lines = [], []

    def get_logger(self):
        return Box(info=self.lines.append)

    def create_timer(self, period_s, callback, *, clock):
        self.timers.append((period_s, callback))
        return self.timers[-1]

    def destroy_timer(self, timer):
        self.timers.remove(timer)


@pytest.fixture
def node(tmp_path, monkeypatch):
    """A node whose compiler is a program that writes its nice value down."""
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SST_ROS_NUMBA", raising=False)
    program = tmp_path / "python"
    program.write_text(FAKE.format(python=sys.executable, folder=str(tmp_path)))
    program.chmod(0o755)
    monkeypatch.setattr(simulator.sys, "executable", str(program))
    return Node()


def compiler(node):
    return CodeCompiler(node, load_scene("example2"), SimulatorParameters())


def written(path, timeout=20.0):
    """Wait for a whole line of a file."""
    deadline = time.monotonic() + timeout
    while not (path.exists() and path.read_text().endswith("\n")):
        assert time.monotonic() < deadline, f"no {path.name} within {timeout} s"
        time.sleep(0.01)
    return path.read_text()


def test_it_starts_late_once_and_of_the_lowest_priority(node, tmp_path):
    compiling = compiler(node)
    ((delay_s, start),) = node.timers
    assert not compiling.available and delay_s >= 5.0 and not (tmp_path / "started").exists()
    start()
    compiling.start()  # as the end of the node does
    assert node.timers == []
    assert sum("compiles the scene for the next start" in line for line in node.lines) == 1
    assert written(tmp_path / "started") == "19\n"


def test_there_is_one_while_another_process_compiles(node, tmp_path):
    compiling = compiler(node)
    with (tmp_path / "cache" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        compiling.start()
    assert "another process compiles: this one does not" in node.lines
    assert not (tmp_path / "started").exists() and node.timers == []
