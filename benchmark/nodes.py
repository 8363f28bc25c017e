# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own and in a ROS domain of their own, as benchmarks start
them.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sst_ros.runtime import child_process

EXECUTABLES = Path(__file__).parents[1] / "executables"
_DISCOVERY_S = 60.0  # of a service, on a machine with many busy processes
_TICK = os.sysconf("SC_CLK_TCK")


@contextmanager
def own_domain() -> Iterator[int]:
    """Give the processes that are started inside a ROS domain of their own, on
    localhost.
    """
    number, lock = child_process.lock_domain()
    ours = {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    try:
        with patch.dict(os.environ, ours):
            yield number
    finally:
        os.close(lock)


class Process(subprocess.Popen[str]):
    """A process, by default a node as `ros2 run` starts it, and the kernel's account of
    it.

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
        command_line = (
            [sys.executable, "-c", command] if python else [str(EXECUTABLES / command)]
        )
        options = child_process.words(given)
        if namespace:
            options += ["-r", f"__ns:={namespace}"]
        if options:
            command_line += ["--ros-args", *options]
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        # Nobody reads before the end, and a full pipe would stop the node.
        super().__init__(
            command_line,
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
        return next(
            int(row.split()[1]) for row in text.splitlines() if row.startswith("VmRSS")
        )

    def end(
        self, number: int = signal.SIGINT, timeout: float = 60.0
    ) -> tuple[int, str]:
        """Send a signal, wait for the end.

        Return the exit status and all that was printed.
        """
        if self.poll() is None:
            self.send_signal(number)
        try:
            output, _ = self.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            output, _ = self.communicate()
            return 255, output or ""
        except ValueError:  # its output has been read and closed already
            return self.wait(), ""
        return self.returncode, output or ""


def start_simulator(namespace: str = "", **given: Any) -> Process:
    """Start a simulator, which in lockstep by default would end with the scene's
    duration.
    """
    return Process("simulator", namespace, **{"duration": 0.0, **given})


def wait_for(
    condition: Callable[[], object], what: str, timeout: float = 120.0
) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"no {what} within {timeout:g} s")
        time.sleep(0.1)


class Client:
    """A node of this process that publishes, calls and receives the diagnostics of
    simulators.

    Attributes:
        node: the node, in a context of its own.
        values: of the last diagnostics, by full name of the simulator.
    """

    def __init__(self, number: int) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        # Replies to all clients of a service arrive at each: ten, the default, displace
        # its own.
        self.qos = QoSProfile(depth=1000)
        self.values: dict[str, dict[str, str]] = {}
        self._clients: dict[str, Any] = {}
        self._rclpy, self._context = rclpy, rclpy.Context()
        rclpy.init(context=self._context, domain_id=number)
        self.node = rclpy.create_node("benchmark", context=self._context)
        self.executor = SingleThreadedExecutor(context=self._context)
        self.executor.add_node(self.node)
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._receive, 100
        )

    def _receive(self, message: Any) -> None:
        name = message.status[0].name.removesuffix(": run")
        self.values[name] = {pair.key: pair.value for pair in message.status[0].values}

    @classmethod
    @contextmanager
    def start(cls) -> Iterator[Client]:
        """Give a client in a domain that nothing else on this machine uses."""
        with own_domain() as number, closing(cls(number)) as client:
            yield client

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        self._rclpy.try_shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Receive for so long."""
        self.until(lambda: False, seconds)

    def until(self, condition: Callable[[], Any], timeout: float = 20.0) -> bool:
        """Receive until a condition holds; False after the time-out."""
        deadline = time.monotonic() + timeout
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self.executor.spin_once(timeout_sec=min(left, 0.02))
        return True

    def wait_for(
        self, condition: Callable[[], Any], what: str, timeout: float = 120.0
    ) -> None:
        """Receive until a condition holds."""
        if not self.until(condition, timeout):
            raise SystemExit(f"no {what} within {timeout:g} s")

    def wait_for_runs(self, *names: str) -> None:
        """Wait until simulators, by their full names, say that they run."""

        def are_running() -> bool:
            return all(
                self.values.get(name, {}).get("phase") == "running" for name in names
            )

        self.wait_for(are_running, f"run of {', '.join(names)}", 240.0)

    def call(
        self, service_type: Any, name: str, timeout: float = 10.0, **fields: Any
    ) -> tuple[Any, float]:
        """Call a service; return the reply, or None, and how long it took [s]."""
        if not self.knows(name):
            self._clients[name] = self.node.create_client(
                service_type, name, qos_profile=self.qos
            )
        client = self._clients[name]
        if not self.until(client.service_is_ready, _DISCOVERY_S):
            return None, math.inf
        began = time.monotonic()
        future = client.call_async(service_type.Request(**fields))
        answered = self.until(future.done, timeout)
        return (future.result() if answered else None), time.monotonic() - began

    def knows(self, service: str) -> bool:
        """Return whether a client of this service is there, from an earlier call.

        Clients stay: a server may answer before it has discovered who receives its
        replies, and each new client would run that race again.
        """
        return service in self._clients


class Account:
    """Processor time and ticks of simulators, by full name, from now on."""

    def __init__(self, watch: Client, nodes: dict[str, Process]) -> None:
        self._watch, self._nodes, self._began = watch, nodes, time.monotonic()
        self._before, self._used = self._ticks(), self._processor_s()

    def _ticks(self) -> dict[str, tuple[int, int]]:
        values = {name: self._watch.values[name] for name in self._nodes}
        return {
            name: (int(values_of_node["ticks"]), int(values_of_node["ticks_missed"]))
            for name, values_of_node in values.items()
        }

    def _processor_s(self) -> float:
        return sum(node.processor_s() for node in self._nodes.values())

    def busy(self) -> float:
        """Return the processor time, in percent of a core."""
        used, wall = self._processor_s() - self._used, time.monotonic() - self._began
        return 100.0 * used / wall

    def missed(self) -> dict[str, float]:
        """Return the ticks missed by each, and by all under "", in percent."""
        ticks_now, before = self._ticks(), self._before
        differences = {
            name: [a - b for a, b in zip(ticks_now[name], before[name], strict=True)]
            for name in ticks_now
        }
        differences[""] = [
            sum(column) for column in zip(*differences.values(), strict=True)
        ]
        return {
            name: 100.0 * lost / max(1, kept + lost)
            for name, (kept, lost) in differences.items()
        }
