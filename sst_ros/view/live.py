# SPDX-License-Identifier: Apache-2.0
"""A simulator of one's own to look at, as a process that ends with the view of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

PUBLISH_RATE = 100
"""Samples a second [Hz]: more than a screen shows."""
_END_S = 10.0


@contextmanager
def simulator(scene: str, speed: float = 1.0) -> Iterator[None]:
    """Run a simulator of a scene in a ROS domain of this process, on this machine only.

    A domain that the environment names is used as it is; `speed` is simulated time per time.
    """
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    given = {"scene": scene, "publish_rate": PUBLISH_RATE, "real_time_factor": speed}
    words = [word for key, value in given.items() for word in ("-p", f"{key}:={value}")]
    process = subprocess.Popen(
        [sys.executable, "-m", "sst_ros", "simulator", "--ros-args", *words],
        stdout=subprocess.DEVNULL,
    )
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
