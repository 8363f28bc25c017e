# SPDX-License-Identifier: Apache-2.0
"""The process that compiles a scene for the next start: late, of low priority."""

import contextlib
import os
import re
from unittest.mock import Mock

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
pytest.importorskip("numba", reason="needs numba: pip install .[fast]")

from sst_ros import load_scene
from sst_ros.nodes import simulator
from sst_ros.nodes.simulator import CodeCompiler
from sst_ros.runtime.settings import SimulatorParameters


@pytest.fixture
def node(tmp_path, monkeypatch):
    """A node whose compiler is a program that writes its nice value down."""
    monkeypatch.setenv("SST_ROS_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SST_ROS_NUMBA", raising=False)
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\nnice >> '{tmp_path}/started'\n")
    program.chmod(0o755)
    monkeypatch.setattr(simulator.sys, "executable", str(program))
    return Mock()


@pytest.fixture
def compiling(node):
    return CodeCompiler(node, load_scene("example2"), SimulatorParameters())


def lines(node):
    return [call.args[0] for call in node.get_logger().info.call_args_list]


def test_it_starts_late_once_and_of_the_lowest_priority(node, compiling, tmp_path):
    delay_s, start = node.create_timer.call_args.args
    assert not compiling.available and delay_s >= 5.0 and not (tmp_path / "started").exists()
    start()
    compiling.start()  # as the end of the node does
    node.destroy_timer.assert_called_once_with(node.create_timer.return_value)
    (pid,) = re.findall(r"process (\d+) compiles the scene for the next start", str(lines(node)))
    with contextlib.suppress(ChildProcessError):  # it has ended, and is waited for
        os.waitpid(int(pid), 0)
    assert (tmp_path / "started").read_text() == "19\n"
