# SPDX-License-Identifier: Apache-2.0
"""SIGINT, SIGTERM and SIGHUP of a node, handled before what takes time to import."""

from __future__ import annotations

import signal

_SIGNAL_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
came: set[int] = set()
"""Signals that ask the node to end.

No lock, on which the handler of a second would wait.
"""


def handle() -> None:
    """Have signals end the node in order, also while it starts.

    A SIGINT that the executables have blocked until now is delivered; a SIGHUP that is
    ignored, as by nohup, stays so.
    """
    for number in _SIGNAL_NUMBERS:
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: came.add(number))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))


def interrupt(*, at_once: bool) -> None:
    """Have an unhandled SIGINT end the process at once, or raise KeyboardInterrupt.

    One that is ignored stays so, as behind a shell's `&`.
    """
    usual = (signal.SIG_DFL, signal.default_int_handler)
    if signal.getsignal(signal.SIGINT) not in usual:
        return
    if at_once:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    else:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def ignore() -> None:
    """Ignore signals from now on: Python gives up its handlers before it has exited."""
    for number in _SIGNAL_NUMBERS:
        signal.signal(number, signal.SIG_IGN)
