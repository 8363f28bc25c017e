# SPDX-License-Identifier: Apache-2.0
"""Nodes that this process starts: processes of their own, in a ROS domain of ours, here only."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

from sst_ros.errors import SstError

PARENT = "SST_ROS_PARENT"
"""Variable with the number of the process without which a node is to end."""

_END_S = 10.0
_DOMAINS = 100
_next = itertools.count(os.getpid())  # what comes later leaves the last ones to end


def start(command: str, given: dict[str, object], **more: Any) -> Popen[str]:
    """Start a node with parameters; it ends when this process does, however that comes."""
    keep_domain()
    return Popen(
        [sys.executable, "-m", "sst_ros", command, "--ros-args", *words(given)],
        env={**os.environ, PARENT: str(os.getpid())},
        text=True,
        **more,
    )


@contextmanager
def run_beside(command: str, given: dict[str, object], **more: Any) -> Iterator[Popen[str]]:
    """Have a node beside a block; it gets SIGINT, and is killed if its end takes 10 s."""
    with start(command, given, **more) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_END_S)
            except subprocess.TimeoutExpired:
                process.kill()


def keep_domain() -> None:
    """Use the ROS domain that the environment names, or else one that this process then keeps."""
    if "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(lock_domain()[0])
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def lock_domain() -> tuple[int, int]:
    """Return the number of a domain, and the descriptor that keeps it until it is closed."""
    for _ in range(_DOMAINS):
        number = 1 + next(_next) % _DOMAINS
        path = Path(tempfile.gettempdir()) / f"sst_ros_domain_{number}"
        with contextlib.suppress(OSError):  # of another user
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(lock)
                continue
            return number, lock
    raise SstError(f"all ROS domains from 1 to {_DOMAINS} are in use: set ROS_DOMAIN_ID")


def words(given: dict[str, object]) -> list[str]:
    """Give parameters as --ros-args takes them."""
    values = (
        (key, str(value).lower() if isinstance(value, bool) else value)
        for key, value in given.items()
    )
    return [word for key, value in values for word in ("-p", f"{key}:={value}")]


def is_orphan() -> bool:
    """Return whether the process that started this one, and without which it ends, has ended."""
    parent = os.environ.get(PARENT)
    return parent is not None and os.getppid() != int(parent)
