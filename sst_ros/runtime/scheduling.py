# SPDX-License-Identifier: Apache-2.0
"""Scheduling of a node by the operating system.

The module sets priority and idle states of the cores, and avoids pauses.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from pathlib import Path
from typing import BinaryIO

NO_LIMIT = "no limit"  # what is said where no latency of idle states is requested
_SWITCH_INTERVAL_S = 1e-4  # a tenth of a control period of 1 ms


def schedule(priority: int, thread: int) -> str:
    """Ask for SCHED_FIFO for all threads (0: for the usual scheduling).

    Return what was granted.

    The thread of this native id gets the priority, 0 to 99. The others of this process
    get half of it: they hold locks that it waits for, the interpreter's and those of
    DDS, and must not be preempted meanwhile. What they begin later, threads or
    processes, is scheduled as usual until the next call. If the thread has ended, a
    ProcessLookupError is raised.
    """
    if not hasattr(os, "sched_setscheduler"):
        return "usual: this system has no SCHED_FIFO"
    if priority == 0:
        if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
            _schedule_all(os.SCHED_OTHER, thread, 0, 0)
        return "usual"
    try:
        _schedule_all(os.SCHED_FIFO, thread, priority, (priority + 1) // 2)
    except ProcessLookupError:
        raise
    except (OSError, ValueError) as error:
        return f"usual: SCHED_FIFO {priority} is not permitted ({error})"
    return f"SCHED_FIFO {priority}"


def _schedule_all(policy: int, thread: int, priority: int, other_priority: int) -> None:
    policy |= os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread, policy, os.sched_param(priority))
    for task in Path("/proc/self/task").iterdir():
        if int(task.name) != thread:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.sched_setscheduler(
                    int(task.name), policy, os.sched_param(other_priority)
                )


class CpuDmaLatency:
    """Request that no core uses idle states of longer exit latency (Linux PM QoS).

    A core that leaves a deep idle state does so late and with cold caches. The kernel
    keeps the request as long as the file is open: it ends with the process, however
    that ends.
    """

    def __init__(self, device: Path = Path("/dev/cpu_dma_latency")) -> None:
        self._device = device
        self._asked_us = -1
        self._granted = NO_LIMIT
        self._file: BinaryIO | None = None

    def request(self, latency_us: int) -> str:
        """Ask for this largest exit latency [us], -1 for no limit.

        Return what was granted.
        """
        if latency_us == self._asked_us:
            return self._granted
        if self._file is not None:
            self._file.close()
        self._file = None
        self._granted = NO_LIMIT
        if latency_us >= 0:
            try:
                self._file = self._device.open("r+b", buffering=0)
                self._file.write(latency_us.to_bytes(4, sys.byteorder))
                self._granted = f"{latency_us} us"
            except OSError as error:
                reason = f"{latency_us} us is not permitted ({error})"
                self._granted = f"{NO_LIMIT}: {reason}"
        self._asked_us = latency_us
        return self._granted


def quiet() -> None:
    """Collect no garbage unasked, and switch threads often.

    To be called when all code is loaded: what exists now is not looked through again.
    A thread that wakes up waits up to the switch interval, 5 ms by default: five ticks.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
