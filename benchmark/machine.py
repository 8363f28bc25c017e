# SPDX-License-Identifier: Apache-2.0
"""Where and with what something was measured."""

from __future__ import annotations

import datetime
import os
import platform
from importlib import metadata
from pathlib import Path


def described(*packages: str) -> dict[str, str]:
    """Date, processor, load and versions; packages that are not installed are left out."""
    told = {
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
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


def _processor() -> str:
    try:
        for row in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if row.startswith("model name"):
                return row.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
