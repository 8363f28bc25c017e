# SPDX-License-Identifier: Apache-2.0
"""Nodes in a ROS domain of their own, a client of them, and the bounds that they keep."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmark.campaign.ledger import Ledger
from sst_ros.host import child_process

FAULT_S = 1.0
"""A step that does not end is a fault within this time."""
REPLY_S = 0.5
"""A node answers every service within this time."""
CLOSE_S = 2.0
"""A node ends within this time of a signal."""
NODE = "/sst_simulator"
EXECUTABLES = Path(__file__).parents[2] / "executables"


@contextmanager
def domain() -> Iterator[int]:
    """Give the processes that are started inside a ROS domain of their own, on localhost."""
    before = os.environ.get("SST_ROS_NUMBA")
    with child_process.own_domain() as number:
        os.environ["SST_ROS_NUMBA"] = "0"
        try:
            yield number
        finally:
            os.environ.pop("SST_ROS_NUMBA", None)
            if before is not None:
                os.environ["SST_ROS_NUMBA"] = before


def start(command: str, patch: str = "", **given: object) -> subprocess.Popen[str]:
    """Start a node as `ros2 run` does, with parameters; `patch` is code that it runs first."""
    words = ["--ros-args", *child_process.words(given)] if given else []
    program = f"{patch}\nimport sys\nfrom sst_ros.__main__ import main\nsys.exit(main())"
    node = [sys.executable, "-c", program, command] if patch else [str(EXECUTABLES / command)]
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return subprocess.Popen(
        [*node, *words], env={**os.environ, "PATH": path},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        pipesize=1 << 20,  # nobody reads before the end, and a full pipe stops the node
    )  # fmt: skip


def ended(process: subprocess.Popen[str], number: int, timeout: float = 20.0) -> tuple[int, str]:
    """Send a signal, wait for the end; return the exit status and all that was printed."""
    if process.poll() is None:
        process.send_signal(number)
    try:
        out, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
        return 255, out or ""
    except ValueError:  # its output has been read and closed already
        return process.wait(), ""
    return process.returncode, out or ""


class Client:
    """A node of this process that publishes, calls and listens."""

    def __init__(self, number: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        # Replies to all clients of a service arrive at each: ten, the default, displace its own.
        self.qos = QoSProfile(depth=1000)
        self.rclpy, self.context = rclpy, rclpy.Context()
        rclpy.init(context=self.context, domain_id=number)
        self.node = rclpy.create_node("campaign", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def until(self, condition: Callable[[], Any], timeout: float = 20.0) -> bool:
        """Spin until a condition holds; False after the time-out."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.executor.spin_once(timeout_sec=0.02)
        return True

    def call(self, kind: Any, name: str, timeout: float = 10.0, **fields: Any) -> tuple[Any, float]:
        """Call a service; return the reply, or None, and how long it took [s]."""
        client: Any = self.node.create_client(kind, name, qos_profile=self.qos)
        try:
            if not self.until(client.service_is_ready):
                return None, math.inf
            future, began = client.call_async(kind.Request(**fields)), time.monotonic()
            done = self.until(future.done, timeout)
            return (future.result() if done else None), time.monotonic() - began
        finally:
            self.node.destroy_client(client)

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.rclpy.try_shutdown(context=self.context)


@contextmanager
def running(patch: str = "", **given: object) -> Iterator[tuple[subprocess.Popen[str], Client]]:
    """Give a running simulator and a client of it."""
    with domain() as number:
        process = start("simulator", patch, **{"scene": "swing", "duration": 0.0, **given})
        client = Client(number)
        try:
            yield process, client
        finally:
            client.close()
            ended(process, signal.SIGKILL)


def is_alive(ledger: Ledger, process: subprocess.Popen[str], client: Client, after: str) -> bool:
    """Count a node that has died or does not answer."""
    from std_srvs.srv import SetBool

    if process.poll() is not None:
        ledger.found("tracebacks", f"the node ended after {after}: {ended(process, 0)[1][-300:]}")
        return False
    reply, took = client.call(SetBool, f"{NODE}/pause", data=False)
    if reply is None:
        ledger.found("lost", f"no reply after {after}")
    elif took > REPLY_S * ledger.patience:
        ledger.found("hangs", f"a reply took {took:.2f} s after {after}")
    ledger.longest_s = max(ledger.longest_s, took if math.isfinite(took) else 0.0)
    return True


def stop(ledger: Ledger, process: subprocess.Popen[str], number: int = signal.SIGINT) -> None:
    began = time.monotonic()
    status, text = ended(process, number)
    took = time.monotonic() - began
    if status not in (0, 1):
        ledger.found("tracebacks", f"exit status {status}")
    if "Traceback" in text:
        ledger.found("tracebacks", text[-300:])
    if took > CLOSE_S * ledger.patience:
        ledger.found("hangs", f"it took {took:.1f} s to close")
