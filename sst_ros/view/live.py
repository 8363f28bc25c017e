# SPDX-License-Identifier: Apache-2.0
"""A simulator of one's own to look at, as a process that ends with the view of it."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from sst_ros.host import child_process

PUBLISH_RATE = 100
"""Samples a second [Hz]: more than a screen shows."""
_END_S = 10.0


@contextmanager
def simulator(scene: str, speed: float = 1.0) -> Iterator[None]:
    """Run a simulator of a scene; `speed` is simulated time per time."""
    given: dict[str, object] = {
        "scene": scene,
        "publish_rate": PUBLISH_RATE,
        "real_time_factor": speed,
        "duration": 0.0,
    }
    process = child_process.start("simulator", given, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
