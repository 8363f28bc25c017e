# SPDX-License-Identifier: Apache-2.0
"""Runs in processes beside each other: in order, and gone with their parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from studies import run_jobs

ASKING = "from test_job_list import waiting; waiting()"


def slow(number):
    """Print the process id, then work for long."""
    os.write(1, f"{os.getpid()}\n".encode())  # in one piece: two write at once
    time.sleep(60.0)
    return number


def waiting():
    run_jobs(slow, [1, 2], workers=2)


def test_results_come_in_the_order_of_the_points():
    assert run_jobs(abs, [-3, 2, -1, 0], workers=2) == [3, 2, 1, 0]


def test_no_worker_outlives_a_parent_that_is_killed():
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    parent = subprocess.Popen(
        [sys.executable, "-c", ASKING],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    parent.send_signal(signal.SIGKILL)
    parent.wait(10)
    end = time.monotonic() + 10
    while any(_lives(pid) for pid in workers):
        assert time.monotonic() < end, "a worker lives on"
        time.sleep(0.05)
    parent.stdout.close()


def _lives(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]
    except OSError:
        return False
