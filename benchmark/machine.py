# SPDX-License-Identifier: Apache-2.0
"""Where and with what something was measured."""

from __future__ import annotations

import datetime
import os
import platform
from importlib import metadata

from sst_ros.report.summary import processor


def described(*packages: str) -> dict[str, str]:
    """Date, processor, load and versions; packages that are not installed are left out."""
    told = {
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "load": f"{os.getloadavg()[0]:.2f} at the end, over 1 min",
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }
    for package in packages:
        try:
            told[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return told


def line(told: dict[str, str]) -> str:
    """One line of text."""
    return ", ".join(f"{key} {value}" for key, value in told.items())
