# SPDX-License-Identifier: Apache-2.0
"""Nodes as child processes, in a ROS domain that nothing else on this machine has."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

from sst_ros.errors import SstError

# variable with the number of the process without which a node is to end
PARENT = "SST_ROS_PARENT"
_NODE_END_S = 10.0  # time that a node may take to end before it is killed
_DOMAINS = 100  # ROS domains of this machine, 1 to 100: DDS allows 1 to 101 on Linux
_PARTICIPANTS = 32  # ports of a domain that are probed: participants on one machine
_next = itertools.count(os.getpid())  # what comes later leaves the last ones to end


@contextmanager
def run_beside(
    command: str, parameters: dict[str, object], **popen_options: Any
) -> Iterator[Popen[str]]:
    """Have a node with parameters beside a block.

    It ends when this process does, however.

    Behind the block it gets SIGINT, and is killed if its end takes 10 s.
    """
    keep_domain()
    started = [
        sys.executable,
        "-m",
        "sst_ros",
        command,
        "--ros-args",
        *words(parameters),
    ]
    with Popen(
        started,
        env={**os.environ, PARENT: str(os.getpid())},
        text=True,
        **popen_options,
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_NODE_END_S)
            except subprocess.TimeoutExpired:
                process.kill()


def keep_domain() -> None:
    """Use the ROS domain of the environment, or else one that this process keeps."""
    if "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(lock_domain()[0])
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def lock_domain() -> tuple[int, int]:
    """Return the number of a domain, and the descriptor that keeps it until closed.

    No node is in it, neither one whose parent has just ended nor one that a user has
    started.
    """
    for _ in range(_DOMAINS):
        number = 1 + next(_next) % _DOMAINS
        path = Path(tempfile.gettempdir()) / f"sst_ros_domain_{number}"
        with contextlib.suppress(OSError):  # of another user
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _refuse_nodes(number)
            except OSError:
                os.close(lock)
                continue
            return number, lock
    raise SstError(
        f"all ROS domains from 1 to {_DOMAINS} are in use: set ROS_DOMAIN_ID"
    )


def _refuse_nodes(domain: int) -> None:
    """Raise OSError where a port of a participant of this domain is taken.

    The ports are those of RTPS 2.5, 9.6.2.3.
    """
    for port in range(7410 + 250 * domain, 7410 + 250 * domain + 2 * _PARTICIPANTS, 2):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", port))


def words(parameters: dict[str, object]) -> list[str]:
    """Give parameters as --ros-args takes them."""
    values = {
        key: str(x).lower() if isinstance(x, bool) else x
        for key, x in parameters.items()
    }
    return [
        argument
        for key, value in values.items()
        for argument in ("-p", f"{key}:={value}")
    ]


def is_orphan() -> bool:
    """Return whether the process that started this one has ended.

    Without that process this one ends.
    """
    parent = os.environ.get(PARENT)
    return parent is not None and os.getppid() != int(parent)
