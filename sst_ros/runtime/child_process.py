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

PARENT = "SST_ROS_PARENT"
"""Variable with the number of the process without which a node is to end."""
_NODE_END_S = 10.0
"""Time that a node may take to end before it is killed."""
_DOMAINS = 100
"""ROS domains of this machine, 1 to 100: DDS allows 1 to 101 on Linux."""
_PARTICIPANTS = 32
"""Participants of a domain on this machine whose ports are probed."""
# Domains in turn: one that was left just now may still have nodes that end.
_next_domain = itertools.count(os.getpid())


@contextmanager
def run_beside(
    command: str, parameters: dict[str, object], **popen_options: Any
) -> Iterator[Popen[str]]:
    """Run a node with parameters beside a block.

    Behind the block it gets SIGINT, and is killed if its end takes 10 s. It also ends
    when this process does, however that ends.
    """
    keep_domain()
    command_line = [sys.executable, "-m", "sst_ros", command]
    command_line += ["--ros-args", *words(parameters)]
    with Popen(
        command_line,
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
        number, _ = lock_domain()  # until this process ends
        os.environ["ROS_DOMAIN_ID"] = str(number)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def lock_domain() -> tuple[int, int]:
    """Return the number of a domain, and the descriptor that keeps it until closed.

    No node is in it, neither one whose parent has just ended nor one that a user has
    started.
    """
    for _ in range(_DOMAINS):
        number = 1 + next(_next_domain) % _DOMAINS
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
    first_port = 7400 + 250 * domain + 10  # unicast discovery of participant 0
    for participant in range(_PARTICIPANTS):
        port = first_port + 2 * participant
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("", port))


def words(parameters: dict[str, object]) -> list[str]:
    """Return parameters as --ros-args takes them."""
    arguments: list[str] = []
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{key}:={text}"]
    return arguments


def is_orphan() -> bool:
    """Return whether the process that started this one has ended.

    Without that process this one ends.
    """
    parent = os.environ.get(PARENT)
    return parent is not None and os.getppid() != int(parent)
