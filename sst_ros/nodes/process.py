# SPDX-License-Identifier: Apache-2.0
"""One process, one node: start, spin until it is done or stopped, close in order."""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Protocol

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from sst_ros.errors import InputError, SstError
from sst_ros.host.child_process import orphaned
from sst_ros.nodes import arguments, middleware, shared_memory, signals

_POLL_S = 0.1
"""Longest delay of a signal. The executor would take half a millisecond for each look."""
_CALLBACK_S = 1.0
"""Wait for a callback in progress: a service that waits for the run ends once that is closed."""
_CLEAN_UP_S = 10.0
"""Longer than any clean-up of the middleware, also on a busy machine."""
_STDERR = 2


class Worker(Protocol):
    """What a process runs: a node, `done` when its work is."""

    node: Node
    done: threading.Event

    def close(self) -> None:
        """Finish while still connected; raise an SstError where the work has failed.

        What it publishes is received by its subscribers before the node leaves.
        """


def run(words: Sequence[str]) -> int:
    """Run a node until SIGINT, SIGTERM, its end or the end of its parent.

    The signal handlers of rclpy would cut the connection at once; ours let the worker close.

    Args:
        words: a key of `arguments.COMMANDS` and the arguments behind it.

    Returns:
        The exit status: 0, 1 for a failure, 2 for arguments that are refused.

    """
    signals.handle()
    command, *given = words
    if arguments.wants_help(given):
        print(arguments.help_text(command))
        return 0
    middleware.configure()
    shared_memory.remove_dead()
    try:
        ros = arguments.ros_arguments(command, given)
        for line in arguments.params_file_warnings(command, ros):
            print(f"{command}: {line}", file=sys.stderr)
        rclpy.init(args=[command, *ros], signal_handler_options=SignalHandlerOptions.NO)
    except (InputError, RuntimeError, ValueError) as error:  # the latter from rcl
        text = str(error) if isinstance(error, InputError) else str(error).splitlines()[0]
        print(text if text.startswith(command) else f"{command}: {text}", file=sys.stderr)
        return 2
    try:
        if not signals.stop.is_set():
            module = importlib.import_module(f"sst_ros.nodes.{command}")
            spin(getattr(module, arguments.COMMANDS[command][0])())
    except (SstError, ParameterException) as error:
        print(f"{command}: {error}", file=sys.stderr)
        return 1
    finally:
        with _bounded():
            rclpy.try_shutdown()
        signals.ignore()
    return 0


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """End the process, with a traceback and status 1, where the middleware hangs for ten seconds.

    Fast DDS 3.2 deadlocks now and then when another node leaves (eProsima/Fast-DDS issue 6502), and
    rclpy holds the interpreter's lock while it gives up a node: neither another thread nor a signal
    could end it from Python.
    """
    faulthandler.dump_traceback_later(_CLEAN_UP_S, exit=True, file=_STDERR)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


class _Callbacks(threading.Thread):
    """Thread of the executor: it sleeps until there is work, where signals would not wake it."""

    def __init__(self, node: Node) -> None:
        super().__init__(name="executor", daemon=True)
        self.error: BaseException | None = None
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._wake = node.create_guard_condition(lambda: None)
        self._ends = False

    def run(self) -> None:
        """Run callbacks until `end`, or until one fails."""
        try:
            while not self._ends:
                self._executor.spin_once()
        except BaseException as error:
            self.error = error

    def end(self) -> None:
        """Begin no other callback; wait for the one in progress."""
        self._ends = True
        self._wake.trigger()
        self.join(_CALLBACK_S)

    def shut_down(self) -> None:
        """Give up the executor, after `end`."""
        self.join(_CALLBACK_S)
        self._executor.shutdown()


def spin(worker: Worker) -> None:
    """Run a worker until it is done or asked to end, then close it.

    Raises:
        Exception: that of a callback, or of closing the worker.

    """
    callbacks = _Callbacks(worker.node)
    callbacks.start()
    try:
        while callbacks.is_alive() and not (signals.stop.is_set() or orphaned()):
            if worker.done.wait(_POLL_S):
                break
        callbacks.end()
        if callbacks.error is not None:
            raise callbacks.error
    finally:
        try:
            worker.close()
        finally:
            with _bounded():
                middleware.finish(worker.node.publishers)
                callbacks.shut_down()
                worker.node.destroy_node()
