# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own and in a ROS domain of their own, as benchmarks start them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sst_ros.host import child_process

EXECUTABLES = Path(__file__).parents[1] / "executables"
_TICK = os.sysconf("SC_CLK_TCK")


@contextmanager
def own_domain(*, compiled: bool = True) -> Iterator[int]:
    """Give the processes that are started inside a ROS domain of their own, on localhost."""
    before = os.environ.pop("SST_ROS_NUMBA", None)
    with child_process.own_domain() as number:
        if not compiled:
            os.environ["SST_ROS_NUMBA"] = "0"
        try:
            yield number
        finally:
            os.environ.pop("SST_ROS_NUMBA", None)
            if before is not None:
                os.environ["SST_ROS_NUMBA"] = before


class Process(subprocess.Popen[str]):
    """A process, by default a node as `ros2 run` starts it, and the kernel's account of it.

    Args:
        command: which node; or code with `python`.
        namespace: of the node.
        python: the command is a program in Python.
        stderr: where its messages go.
        given: parameters of the node.

    """

    def __init__(
        self,
        command: str,
        namespace: str = "",
        *,
        python: bool = False,
        stderr: int = subprocess.DEVNULL,
        **given: Any,
    ) -> None:
        words = [sys.executable, "-c", command] if python else [str(EXECUTABLES / command)]
        options = child_process.words(given)
        if namespace:
            options += ["-r", f"__ns:={namespace}"]
        if options:
            words += ["--ros-args", *options]
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        # Nobody reads before the end, and a full pipe would stop the node.
        super().__init__(
            words,
            env={**os.environ, "PATH": path},
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            pipesize=1 << 20,
        )

    def line(self) -> str:
        """Wait for a line of its output."""
        assert self.stdout is not None
        return self.stdout.readline()

    def processor_s(self) -> float:
        """Processor time since its start [s]."""
        text = Path(f"/proc/{self.pid}/stat").read_text(encoding="utf-8")
        fields = text.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICK

    def memory_kb(self) -> int:
        """Memory that it uses [kB]."""
        text = Path(f"/proc/{self.pid}/status").read_text(encoding="utf-8")
        return next(int(row.split()[1]) for row in text.splitlines() if row.startswith("VmRSS"))

    def end(self, number: int = signal.SIGINT, timeout: float = 60.0) -> tuple[int, str]:
        """Send a signal, wait for the end; return the exit status and all that was printed."""
        if self.poll() is None:
            self.send_signal(number)
        try:
            out, _ = self.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            out, _ = self.communicate()
            return 255, out or ""
        except ValueError:  # its output has been read and closed already
            return self.wait(), ""
        return self.returncode, out or ""


def start_simulator(namespace: str = "", **given: Any) -> Process:
    """Start a simulator, which by default would end with the scene's duration."""
    return Process("simulator", namespace, **{"duration": 0.0, **given})


def wait_for(condition: Callable[[], object], what: str, timeout: float = 120.0) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"no {what} within {timeout:g} s")
        time.sleep(0.1)


class Watch:
    """Receives the diagnostics of every simulator.

    Attributes:
        values: of the last message, by full name of the node.

    """

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor

        self.node = rclpy.create_node("benchmark")
        self.values: dict[str, dict[str, str]] = {}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive, 100)

    def _receive(self, message: Any) -> None:
        name = message.status[0].name.removesuffix(": run")
        self.values[name] = {pair.key: pair.value for pair in message.status[0].values}

    @classmethod
    @contextmanager
    def start(cls) -> Iterator[Watch]:
        """Watch a domain that nothing else on this machine uses."""
        import rclpy

        with own_domain():
            rclpy.init()
            watch = cls()
            try:
                yield watch
            finally:
                watch.node.destroy_node()
                rclpy.try_shutdown()

    def spin(self, seconds: float) -> None:
        """Receive for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))

    def wait_for(self, condition: Any, what: str, timeout: float = 120.0) -> None:
        """Receive until a condition holds."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f"no {what} within {timeout:g} s")
            self._executor.spin_once(timeout_sec=0.1)

    def phase(self, name: str) -> str:
        """Phase that a simulator last said, empty before."""
        return self.values.get(name, {}).get("phase", "")
