# SPDX-License-Identifier: Apache-2.0
"""One process, one node: start, spin until told to stop, leave without a trace."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from typing import Protocol

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from sst_ros.child_process import orphaned
from sst_ros.errors import SstError
from sst_ros.nodes import middleware, raw_handles

_SPIN_PERIOD_S = 0.1
"""So late may a signal be heard; to spin once takes half a millisecond, asked for or not."""


class Worker(Protocol):
    """What a process runs: a node that is `done` when its work is, and closes in order."""

    node: Node
    done: threading.Event

    def close(self) -> None:
        """Finish: still connected, the last thing to publish or write goes out here."""


def run(name: str, build: Callable[[], Worker], args: list[str] | None = None) -> int:
    """Run until SIGINT, SIGTERM, or the worker is done, or its parent; return the exit status.

    The signal handlers of rclpy would cut the connection at once; ours let the worker close.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    middleware.configure()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:  # what rcl makes of bad --ros-args
        print(f"{name}: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    try:
        return _spin(build, stop)
    except (SstError, ParameterException) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()


def _spin(build: Callable[[], Worker], stop: threading.Event) -> int:
    worker = build()
    executor = SingleThreadedExecutor()
    executor.add_node(worker.node)
    try:
        while not (stop.is_set() or worker.done.is_set() or orphaned()):
            executor.spin_once(timeout_sec=_SPIN_PERIOD_S)
    finally:
        try:
            worker.close()
        finally:
            executor.shutdown()
            raw_handles.release()
            worker.node.destroy_node()
    return 0
