# SPDX-License-Identifier: Apache-2.0
"""Where and with what something was measured."""

from __future__ import annotations

import datetime
import os
import platform
from importlib import metadata

from sst_ros.report.results import processor


def described(*packages: str) -> dict[str, str]:
    """Date, processor, load and versions; packages that are not installed are left out."""
    host = {
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "load": f"{os.getloadavg()[0]:.2f} at the end, over 1 min",
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
    }
    for package in packages:
        try:
            host[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return host


def line(host: dict[str, str]) -> str:
    """One line of text."""
    return ", ".join(f"{key} {value}" for key, value in host.items())
