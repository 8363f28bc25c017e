# SPDX-License-Identifier: Apache-2.0
"""What a thread can ask of the machine to be on time, and what it got. No ROS in here."""

from __future__ import annotations

import gc
import os
import sys

_SWITCH_INTERVAL_S = 1e-4


def schedule(priority: int) -> str:
    """Ask for SCHED_FIFO for the calling thread (0: for the usual scheduling); say what it got."""
    if not hasattr(os, "sched_setscheduler"):
        return "usual: this system has no SCHED_FIFO"
    if priority == 0:
        if os.sched_getscheduler(0) != os.SCHED_OTHER:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        return "usual"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, ValueError) as error:
        return f"usual: SCHED_FIFO {priority} is not permitted ({error})"
    return f"SCHED_FIFO {priority}"


def quiet() -> None:
    """Keep the interpreter out of the way: no garbage collection but `tidy`, short turns.

    A thread that wakes up waits for another's turn to end, 5 ms by default: five ticks.
    """
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()


def tidy() -> None:
    """Collect the little that has become garbage since `quiet`."""
    gc.collect()
