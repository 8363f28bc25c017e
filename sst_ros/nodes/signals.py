# SPDX-License-Identifier: Apache-2.0
"""SIGINT and SIGTERM of a node, handled before what takes time to import."""

from __future__ import annotations

import signal


class StopRequest:
    """Whether SIGINT or SIGTERM came; no lock, on which the handler of a second would wait."""

    def __init__(self) -> None:
        self._came = False

    def set(self) -> None:
        """Ask the node to end."""
        self._came = True

    def is_set(self) -> bool:
        """Return whether the node is to end."""
        return self._came


stop = StopRequest()


def handle() -> None:
    """Have SIGINT and SIGTERM end the node in order, also while it starts.

    A SIGINT that the executables have blocked until now is delivered.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))


def ignore() -> None:
    """Ignore signals from now on: Python gives up its handlers before it has exited."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
