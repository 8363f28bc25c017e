# SPDX-License-Identifier: Apache-2.0
"""Torque profiles: what the actuators do over time, from a scene or from a table."""

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

from sst_ros.errors import InputError, Problem
from sst_ros.scene.scene import SineTorque

Torque = tuple[float, float, float]
Profile = Callable[[float], Torque]


def sine(torque: SineTorque) -> Profile:
    """Return tau(t) [N m] of time [s]."""
    rows = tuple(zip(torque.amplitude, torque.frequency, torque.phase, strict=True))

    def profile(time: float) -> Torque:
        first, second, third = (a * math.sin(f * time + p) for a, f, p in rows)
        return (first, second, third)

    return profile


def table(path: Path) -> tuple[Profile, float]:
    """Read a CSV file with a header and the columns time, tau_1, tau_2, tau_3.

    Each row holds from its time [s] until the next; before the first row the torque is zero.

    Returns:
        The profile and the time of the last row [s].

    Raises:
        InputError: the file cannot be read; lists every bad row with its line.

    """
    origin = str(path)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(origin, [Problem("csv", origin, f"must be readable ({error})")]) from None
    header = ["time", "tau_1", "tau_2", "tau_3"]
    found = rows[0][1] if rows else None
    if found is None or [name.strip() for name in found] != header:
        raise InputError(origin, [Problem("header", found, "must be " + ", ".join(header), 1)])
    times: list[float] = []
    torques: list[Torque] = []
    problems = []
    for line, row in rows[1:]:
        try:
            time, first, second, third = (float(entry) for entry in row)
        except ValueError:
            time = math.nan
        if not (math.isfinite(time) and all(math.isfinite(float(entry)) for entry in row)):
            problems.append(Problem("row", row, "must be four finite numbers", line))
        elif times and time <= times[-1]:
            problems.append(Problem("time", time, f"must be > {times[-1]:g} s, the last", line))
        else:
            times.append(time)
            torques.append((first, second, third))
    if not problems and not times:
        problems.append(Problem("rows", 0, "must be one or more"))
    if problems:
        raise InputError(origin, problems)

    def profile(time: float) -> Torque:
        index = bisect_right(times, time)
        return torques[index - 1] if index else (0.0, 0.0, 0.0)

    return profile, times[-1]
