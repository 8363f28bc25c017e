# SPDX-License-Identifier: Apache-2.0
"""Entry points of the nodes: signals and arguments before what takes time to import."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
from collections.abc import Sequence

stop = threading.Event()
"""Set by SIGINT or SIGTERM."""

_EXTRAS = {"rclpy": "ros", "rosbags": "record", "viser": "view"}
"""Modules that a node needs and the extra that installs them."""


def handle_signals() -> None:
    """Have SIGINT and SIGTERM end the node in order, also while it starts."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())


def main(command: str, words: Sequence[str] | None = None) -> int:
    """Run a node until it is done or stopped.

    Args:
        command: simulator, torque_player, inverse_dynamics, recorder or viewer.
        words: arguments without the program's name; those of the process where None.

    Returns:
        The exit status: 0 for a run that ended, 1 for a failure, 2 for arguments that are refused.

    """
    handle_signals()
    given = sys.argv[1:] if words is None else list(words)
    try:
        module = importlib.import_module(f"sst_ros.nodes.{command}")
    except ModuleNotFoundError as missing:
        from sst_ros.nodes import arguments

        if arguments.wants_help(given):
            print(arguments.help_text(command))
            return 0
        package = (missing.name or "").partition(".")[0]
        how = f"; pip install 'sst_ros[{_EXTRAS[package]}]'" if package in _EXTRAS else ""
        print(f"{command}: needs the module {missing.name}{how}", file=sys.stderr)
        return 1
    status: int = module.main([command, *given])
    return status


def simulator() -> int:
    """Entry point of `simulator`."""
    return main("simulator")


def torque_player() -> int:
    """Entry point of `torque_player`."""
    return main("torque_player")


def inverse_dynamics() -> int:
    """Entry point of `inverse_dynamics`."""
    return main("inverse_dynamics")


def recorder() -> int:
    """Entry point of `recorder`."""
    return main("recorder")


def viewer() -> int:
    """Entry point of `viewer`."""
    return main("viewer")
