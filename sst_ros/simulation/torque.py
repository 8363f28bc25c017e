# SPDX-License-Identifier: Apache-2.0
"""Torques as a user gives them: tables in files, numbers, profiles and functions."""

from __future__ import annotations

import csv
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.errors import InputError, Problem
from sst_ros.scene.loads import SineTorque
from sst_ros.simulation.torque_profile import (
    Array,
    ConstantTorque,
    FeedbackFunction,
    FunctionTorque,
    LostTorque,
    PolynomialTorque,
    SineProfile,
    TorqueProfile,
    three,
)


class TorqueTable(TorqueProfile):
    """Held torques: each row acts from its time until the next; zero before the first.

    Args:
        times: beginnings [s], shape (n,), strictly ascending.
        torques: torques [N m], shape (n, 3).

    Raises:
        InputError: shapes, order or numbers are not allowed.

    """

    def __init__(self, times: ArrayLike, torques: ArrayLike) -> None:
        self.times = np.array(times, dtype=float)
        self.torques = np.array(torques, dtype=float)
        problems = []
        if self.times.ndim != 1 or not len(self.times) or np.any(np.diff(self.times) <= 0.0):
            problems.append(Problem("times", times, "must be ascending times [s], shape (n,)"))
        elif self.torques.shape != (len(self.times), 3):
            allowed = f"must have the shape ({len(self.times)}, 3) [N m]"
            problems.append(Problem("torques", self.torques.shape, allowed))
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.torques))):
            problems.append(Problem("times, torques", "not finite", "must be finite numbers"))
        if problems:
            raise InputError("torque table", problems)

    @classmethod
    def read(cls, path: str | Path) -> TorqueTable:
        """Read a CSV file with the header time, tau_1, tau_2, tau_3 [s, N m].

        Raises:
            InputError: the file cannot be read; lists every bad row with its line.

        """
        return cls(*_csv_table(Path(path)))

    def values(self, t: Array) -> Array:
        """See `TorqueProfile`."""
        rows = np.vstack([np.zeros(3), self.torques])
        return np.asarray(rows[np.searchsorted(self.times, t, side="right")])

    def breaks(self) -> Array:
        """See `TorqueProfile`."""
        return self.times

    def between(self, begin: float, end: float) -> ConstantTorque:
        """See `TorqueProfile`."""
        return ConstantTorque(self(0.5 * (begin + end)))

    def record(self) -> dict[str, Any]:
        """See `TorqueProfile`."""
        return {"kind": "table", "times": self.times.tolist(), "torques": self.torques.tolist()}


def profile_of(torque: Any) -> TorqueProfile | FeedbackFunction:
    """Turn what a user gives into a profile, or leave a function of time and state as it is.

    Raises:
        InputError: it is none of the kinds that `simulate` allows.

    """
    if isinstance(torque, TorqueProfile):
        return torque
    if isinstance(torque, SineTorque):
        return SineProfile(torque)
    if hasattr(torque, "c") and hasattr(torque, "x") and callable(torque):
        return PolynomialTorque(torque.c, torque.x)  # scipy.interpolate.PPoly, CubicSpline
    if callable(torque):
        function: FeedbackFunction = torque
        return function if _arguments(torque) == 2 else FunctionTorque(torque)
    return ConstantTorque(three(torque, "torque"))


def profile_from(record: dict[str, Any] | None) -> TorqueProfile | None:
    """Build the profile that `TorqueProfile.record` has described."""
    if record is None:
        return None
    more = {name: value for name, value in record.items() if name != "kind"}
    if record["kind"] == "function":
        return LostTorque()
    if record["kind"] == "constant":
        return ConstantTorque(three(more["torque"], "torque"))
    if record["kind"] == "sine":
        return SineProfile(SineTorque(**more))
    if record["kind"] == "table":
        return TorqueTable(more["times"], more["torques"])
    return PolynomialTorque(more["c"], more["x"])


def _arguments(function: Callable[..., Any]) -> int:
    """Positional arguments that a function must be given, 1 or 2.

    Raises:
        InputError: it needs another number.

    """
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return 1
    places = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    needed = [p for p in places if p.default is p.empty]
    if len(needed) > 2 or not (places or any(p.kind == p.VAR_POSITIONAL for p in parameters)):
        allowed = "must be a function f(t) or f(t, state)"
        raise InputError("simulate", [Problem("torque", function, allowed)])
    return 2 if len(needed) == 2 else 1


def _csv_table(path: Path) -> tuple[list[float], list[list[float]]]:
    origin = str(path)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(origin, [Problem("csv", origin, f"must be readable ({error})")]) from None
    header = ["time", "tau_1", "tau_2", "tau_3"]
    found = [name.strip() for name in lines[0][1]] if lines else None
    if found != header:
        raise InputError(origin, [Problem("header", found, "must be " + ", ".join(header), 1)])
    rows: list[list[float]] = []
    problems = list(_bad_rows(lines[1:], rows))
    if not problems and not rows:
        problems.append(Problem("rows", 0, "must be one or more"))
    if problems:
        raise InputError(origin, problems)
    return [row[0] for row in rows], [row[1:] for row in rows]


def _bad_rows(lines: list[tuple[int, list[str]]], rows: list[list[float]]) -> Iterator[Problem]:
    """Yield the faults of a table, and append what is right to `rows`."""
    for line, entries in lines:
        try:
            row = [float(entry) for entry in entries]
        except ValueError:
            row = []
        if len(row) != 4 or not np.all(np.isfinite(row)):
            yield Problem("row", entries, "must be four finite numbers", line)
        elif rows and row[0] <= rows[-1][0]:
            yield Problem("time", row[0], f"must be > {rows[-1][0]:g} s, the last", line)
        else:
            rows.append(row)
