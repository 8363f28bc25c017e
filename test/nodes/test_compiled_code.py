# SPDX-License-Identifier: Apache-2.0
"""The process that compiles a scene for the next start: late, of low priority, one only."""

import contextlib
import fcntl
import os
import re
import sys
from types import SimpleNamespace as Box

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
pytest.importorskip("numba", reason="needs numba: pip install .[fast]")

from sst_ros import load_scene
from sst_ros.nodes import simulator
from sst_ros.nodes.simulator import CodeCompiler
from sst_ros.runtime.settings import SimulatorParameters

FAKE = """#!{python}
import os
with open({path!r}, "a") as file:
    print(os.nice(0), file=file)
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
    program.write_text(FAKE.format(python=sys.executable, path=str(tmp_path / "started")))
    program.chmod(0o755)
    monkeypatch.setattr(simulator.sys, "executable", str(program))
    return Node()


@pytest.fixture
def compiling(node):
    return CodeCompiler(node, load_scene("example2"), SimulatorParameters())


def test_it_starts_late_once_and_of_the_lowest_priority(node, compiling, tmp_path):
    ((delay_s, start),) = node.timers
    assert not compiling.available and delay_s >= 5.0 and not (tmp_path / "started").exists()
    start()
    compiling.start()  # as the end of the node does
    assert node.timers == []
    assert sum("compiles the scene for the next start" in line for line in node.lines) == 1
    with contextlib.suppress(ChildProcessError):  # it has ended, and is waited for
        os.waitpid(int(re.search(r"process (\d+) compiles", "".join(node.lines))[1]), 0)
    assert (tmp_path / "started").read_text() == "19\n"


def test_there_is_one_while_another_process_compiles(node, compiling, tmp_path):
    with (tmp_path / "cache" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        compiling.start()
    assert "another process compiles: this one does not" in node.lines
    assert not (tmp_path / "started").exists() and node.timers == []
