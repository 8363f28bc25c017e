# SPDX-License-Identifier: Apache-2.0
"""Bounds of time that other work on the machine does not shorten."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

_LOOK_S = 0.01
"""How often an ending process is looked at: the account of a thread ends with it."""
_NANOSECOND = 1e-9


class OwnTime:
    """Time from now on, less what the threads of some processes wait for a processor.

    A busy machine makes these waits long, a fault of the program makes the rest long.
    The kernel counts them for each thread (/proc/PID/task/TID/schedstat); where it does
    not, this is the time of the clock. Waits of a thread that ends between two looks
    are not seen.

    Args:
        pids: numbers of the processes.

    """

    def __init__(self, *pids: int) -> None:
        self._pids = pids
        self._began = time.monotonic()
        self._first = self._waits()
        self._last = dict(self._first)

    def _waits(self) -> dict[str, int]:
        """Return how long each thread has waited [ns], by its folder in /proc."""
        waits = {}
        for pid in self._pids:
            for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                try:
                    account = path.read_text(encoding="ascii").split()
                except OSError:  # the thread has ended
                    continue
                waits[str(path.parent)] = int(account[1])
        return waits

    def seconds(self) -> float:
        """Return this time [s]."""
        self._last.update(self._waits())
        waited_ns = sum(
            wait - self._first.get(thread, 0) for thread, wait in self._last.items()
        )
        elapsed_s = time.monotonic() - self._began
        return max(0.0, elapsed_s - _NANOSECOND * waited_ns)


def wait_for_end(process: subprocess.Popen[str], bound_s: float) -> float:
    """Wait for a process whose output fits in its pipe; return how long that took [s].

    After `bound_s` of own time it is left as it is.
    """
    own_time = OwnTime(process.pid)
    while process.poll() is None and own_time.seconds() < bound_s:
        time.sleep(_LOOK_S)
    return own_time.seconds()


def communicate(process: subprocess.Popen[str], bound_s: float) -> tuple[str, str]:
    """Read the output of a process until its end.

    Raises:
        subprocess.TimeoutExpired: it was killed after `bound_s` of its own time.

    """
    own_time = OwnTime(process.pid)
    while True:
        try:
            return process.communicate(timeout=1.0)
        except subprocess.TimeoutExpired:
            if own_time.seconds() > bound_s:
                process.kill()
                process.communicate()
                raise
