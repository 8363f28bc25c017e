# SPDX-License-Identifier: Apache-2.0
"""Nodes that this process starts: processes of their own, in a ROS domain of ours, here only."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

PARENT = "SST_ROS_PARENT"
"""Variable with the number of the process without which a node is to end."""


def start(command: str, given: dict[str, object], **more: Any) -> subprocess.Popen[str]:
    """Start a node that ends when this process does, however that comes.

    Args:
        command: which.
        given: its parameters.
        more: for Popen.

    """
    # A domain that the environment names is used as it is.
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return subprocess.Popen(
        [sys.executable, "-m", "sst_ros", command, "--ros-args", *words(given)],
        env={**os.environ, PARENT: str(os.getpid())},
        text=True,
        **more,
    )


def words(given: dict[str, object]) -> list[str]:
    """Give parameters as --ros-args takes them."""
    values = (
        (key, str(value).lower() if isinstance(value, bool) else value)
        for key, value in given.items()
    )
    return [word for key, value in values for word in ("-p", f"{key}:={value}")]


def orphaned() -> bool:
    """Return whether the process that started this one, and without which it ends, has ended."""
    parent = os.environ.get(PARENT)
    return parent is not None and os.getppid() != int(parent)
