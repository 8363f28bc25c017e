# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own, as benchmarks start and watch them; Markdown tables."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from benchmark.campaign.processes import domain
from sst_ros.host import child_process

_TICK = os.sysconf("SC_CLK_TCK")


class Watch:
    """Receives the diagnostics of every simulator.

    Attributes:
        values: of the last message, by full name of the node.

    """

    def __init__(self) -> None:
        self.node = rclpy.create_node("benchmark")
        self.values: dict[str, dict[str, str]] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive, 100)

    def _receive(self, message: DiagnosticArray) -> None:
        name = message.status[0].name.removesuffix(": run")
        self.values[name] = {pair.key: pair.value for pair in message.status[0].values}

    @classmethod
    @contextmanager
    def started(cls) -> Iterator[Watch]:
        """Watch a domain that nothing else on this machine uses."""
        with domain():
            del os.environ["SST_ROS_NUMBA"]
            rclpy.init()
            watch = cls()
            try:
                yield watch
            finally:
                watch.node.destroy_node()
                rclpy.try_shutdown()

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))

    def until(self, condition: Any, what: str, timeout: float = 120.0) -> None:
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f"no {what} within {timeout:g} s")
            self._executor.spin_once(timeout_sec=0.1)

    def phase(self, name: str) -> str:
        return self.values.get(name, {}).get("phase", "")


class Process:
    """A node in a process of its own, and the kernel's account of it."""

    def __init__(self, command: str, namespace: str = "/", **given: Any) -> None:
        if command == "simulator":  # by default it would end with the scene's duration
            given.setdefault("duration", 0.0)
        argv = [sys.executable, "-m", "sst_ros", command, "--ros-args", *child_process.words(given)]
        argv += ["-r", f"__ns:={namespace}"]
        self._process = subprocess.Popen(
            argv, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    @property
    def pid(self) -> int:
        return self._process.pid

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()

    def line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def processor_s(self) -> float:
        text = Path(f"/proc/{self._process.pid}/stat").read_text(encoding="utf-8")
        fields = text.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICK

    def memory_kb(self) -> int:
        text = Path(f"/proc/{self._process.pid}/status").read_text(encoding="utf-8")
        return next(int(row.split()[1]) for row in text.splitlines() if row.startswith("VmRSS"))

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()


def until(condition: Callable[[], object], what: str, timeout: float = 120.0) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"no {what} within {timeout:g} s")
        time.sleep(0.1)


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Markdown of rows, of which the first is the header."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
