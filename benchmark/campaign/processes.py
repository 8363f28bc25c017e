# SPDX-License-Identifier: Apache-2.0
"""Nodes that the campaign starts, a client of them, and the bounds that they keep."""

from __future__ import annotations

import math
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from benchmark.campaign.ledger import Ledger
from benchmark.nodes import Process, own_domain

FAULT_S, REPLY_S, CLOSE_S = 1.0, 0.5, 2.0
"""Within this time a step that does not end is a fault, a node answers a service, and it ends."""

NODE = "/sst_simulator"


def start(command: str, patch: str = "", **given: Any) -> Process:
    """Start a plain node, with parameters; `patch` is code that it runs first."""
    program = f"{patch}\nimport sys\nfrom sst_ros.__main__ import main\n"
    program += f"sys.exit(main([{command!r}, *sys.argv[1:]]))"
    return Process(
        program if patch else command, python=bool(patch), stderr=subprocess.STDOUT, **given
    )


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
def running(patch: str = "", **given: object) -> Iterator[tuple[Process, Client]]:
    """Give a running simulator and a client of it."""
    with own_domain(compiled=False) as number:
        process = start("simulator", patch, **{"scene": "swing", "duration": 0.0, **given})
        client = Client(number)
        try:
            yield process, client
        finally:
            client.close()
            process.end(signal.SIGKILL, 20.0)


def is_alive(ledger: Ledger, process: Process, client: Client, after: str) -> bool:
    """Count a node that has died or does not answer."""
    from std_srvs.srv import SetBool

    if process.poll() is not None:
        ledger.found(
            "tracebacks", f"the node ended after {after}: {process.end(0, 20.0)[1][-300:]}"
        )
        return False
    reply, took = client.call(SetBool, f"{NODE}/pause", data=False)
    if reply is None:
        ledger.found("lost", f"no reply after {after}")
    elif took > REPLY_S * ledger.patience:
        ledger.found("hangs", f"a reply took {took:.2f} s after {after}")
    ledger.longest_s = max(ledger.longest_s, took if math.isfinite(took) else 0.0)
    return True


def stop(ledger: Ledger, process: Process, number: int = signal.SIGINT) -> None:
    began = time.monotonic()
    status, text = process.end(number, 20.0)
    took = time.monotonic() - began
    if status not in (0, 1):
        ledger.found("tracebacks", f"exit status {status}")
    if "Traceback" in text:
        ledger.found("tracebacks", text[-300:])
    if took > CLOSE_S * ledger.patience:
        ledger.found("hangs", f"it took {took:.1f} s to close")
