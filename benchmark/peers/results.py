# SPDX-License-Identifier: Apache-2.0
"""What the study found, as a table, as CSV and as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from pandas import DataFrame

from benchmark import machine
from benchmark.peers.floor import Floor
from benchmark.peers.ours import ENGINE as OURS
from benchmark.peers.ours import PUBLIC
from benchmark.peers.study import TARGETS, Curve, Reached, reached

PACKAGES = ("numpy", "numba", "mujoco", "pin", "drake", "exudyn", "scipy", "mpmath")

CLAIMS = (
    ("MuJoCo", "", "MuJoCo's best setting", {1e-6: 1000, 1e-9: 2000}),
    ("Pinocchio", "RK4", "Pinocchio in a loop of RK4 in Python", {1e-6: 300, 1e-9: 800}),
    ("Pinocchio", "", "Pinocchio under our DOP853 in Python", {1e-6: 300, 1e-9: 800}),
    ("SciPy on the paper's form", "", "SciPy on the NumPy form", {1e-6: 10000, 1e-9: 10000}),
)
"""Engine, begin of the method's name, what it is called, and the target ratio by error."""


@dataclass
class Results:
    """Everything that is reported about a study."""

    curves: list[Curve]
    missing: dict[str, str]
    reference_error: float
    rounds: int
    quick: bool
    seconds: float
    floor: Floor
    machine: dict[str, str] = field(default_factory=lambda: machine.described(*PACKAGES))

    @property
    def engines(self) -> list[str]:
        """Names of the engines that passed, ours first."""
        return list(dict.fromkeys(c.series.engine for c in self.curves if c.passed))

    def best(self, engine: str, target: float, method: str = "") -> Reached:
        """How soon an engine reaches an error by any of its series, or by those of a method.

        Ours by the public call alone, overhead included.
        """
        method = method or (PUBLIC if engine == OURS else "")
        curves = [c for c in self.curves if c.series.engine == engine]
        return reached([c for c in curves if c.series.name.startswith(method)], target)

    def ratio(self, other: Reached, target: float) -> float | None:
        """How many times faster we reach it: median of the quotients of each round."""
        ours = self.best(OURS, target).point
        if ours is None or other.point is None:
            return None
        return median(a / b for a, b in zip(other.point.seconds, ours.seconds, strict=True))

    def claims(self) -> list[tuple[str, float, int, float | None]]:
        """Name, error, wanted and found ratio of each claim on an engine that is here."""
        return [
            (name, target, wanted, self.ratio(self.best(engine, target, method), target))
            for engine, method, name, wants in CLAIMS
            if engine in self.engines
            for target, wanted in wants.items()
        ]


def rows(results: Results) -> list[list[str]]:
    """Cells of the table, heads first: one row a series, then one an engine."""
    heads = ["engine", "method", "Python runs", "gate", *(f"{t:.0e} rad" for t in TARGETS)]
    found = [heads]
    for curve in results.curves:
        series = curve.series
        gate = f"{curve.gate:.0e}" if curve.passed else f"{curve.gate:.0e} FAILED"
        cells = [_cell(results, reached([curve], target), target) for target in TARGETS]
        found.append([series.engine, series.name, series.python, gate, *cells])
    return found


def best_rows(results: Results) -> list[list[str]]:
    """Heads, then the best of each engine, with the settings that did it."""
    found = [["engine, best of all settings", *(f"{t:.0e} rad" for t in TARGETS)]]
    for engine in results.engines:
        cells = [_cell(results, results.best(engine, target), target) for target in TARGETS]
        found.append([engine, *cells])
    found += [[engine, *(["not installed"] * len(TARGETS))] for engine in results.missing]
    return found


def verdicts(results: Results) -> list[str]:
    """One sentence a claim."""
    found = []
    for name, target, wanted, ratio in results.claims():
        if ratio is None:
            found.append(
                f"{target:.0e} rad: {name}: not reached by any setting (target {wanted:,})"
            )
            continue
        verdict = "met" if ratio >= wanted else "NOT met"
        found.append(
            f"{target:.0e} rad: {_rounded(ratio)} times faster than {name}"
            f" (target {wanted:,}: {verdict})"
        )
    return found


def floor_rows(results: Results) -> list[list[str]]:
    """What a program can do at most that evaluates one acceleration at a time, against peers."""
    cost = results.floor.seconds
    heads = ["", *(f"{t:.0e} rad" for t in results.floor.evaluations)]
    counts = ["evaluations, at least", *map(str, results.floor.evaluations.values())]
    if cost is None:
        return [heads, counts]
    times = {t: n * cost for t, n in results.floor.evaluations.items()}
    found = [heads, counts, ["in C [ms]", *(f"{1e3 * x:.3g}" for x in times.values())]]
    for engine in results.engines:
        cells = []
        for target, least in times.items():
            time = results.best(engine, target).time
            cells.append("-" if time is None else f"{_rounded(time / least)} x")
        found.append([f"{engine} over that", *cells])
    return found


def table(results: Results) -> str:
    """Text for the terminal."""
    parts = [
        "One second of Example 2. Processor time [ms] to an error of the orientation at the end,",
        "and how many times that is ours. '-': not reached by any setting tried.",
        "",
        _text(rows(results)),
        "",
        _text(best_rows(results)),
        "",
        *verdicts(results),
        "",
        _text(floor_rows(results)),
        "",
        f"Reference: extrapolation in mpmath, two step sizes {results.reference_error:.0e} rad"
        " apart, kept as doubles (2e-16).",
        f"{machine.line(results.machine)}; medians of {results.rounds} interleaved rounds;"
        f" {results.seconds:.0f} s in all.",
        *(f"{engine}: {why}." for engine, why in results.missing.items()),
    ]
    return "\n".join(parts)


def write(results: Results, folder: Path) -> None:
    """Write peers.csv, one row a setting that was timed or failed, and peers.json."""
    points = [point for curve in results.curves for point in _points(curve)]
    DataFrame(points).to_csv(folder / "peers.csv", index=False, lineterminator="\n")
    document = {
        "machine": results.machine,
        "rounds": results.rounds,
        "quick": results.quick,
        "reference_error_rad": results.reference_error,
        "missing": results.missing,
        "settings_run": sum(len(curve.points) for curve in results.curves),
        "gates": {
            f"{c.series.engine}: {c.series.name}": {
                "relative_difference": c.gate,
                "tolerance": c.series.tolerance,
            }
            for c in results.curves
        },
        "reached": [
            _reached(engine, "", results.best(engine, target), results, target)
            for engine in results.engines
            for target in TARGETS
        ]
        + [
            _reached(c.series.engine, c.series.name, reached([c], target), results, target)
            for c in results.curves
            for target in TARGETS
        ],
        "verdicts": verdicts(results),
        "floor": {
            "evaluations": {f"{t:.0e}": n for t, n in results.floor.evaluations.items()},
            "ns_of_one_in_c": results.floor.seconds and 1e9 * results.floor.seconds,
        },
    }
    text = json.dumps(document, indent=1, ensure_ascii=False)
    (folder / "peers.json").write_text(text + "\n", encoding="utf-8")


def _points(curve: Curve) -> list[dict[str, Any]]:
    return [
        {
            "engine": curve.series.engine,
            "method": curve.series.name,
            "setting": point.setting.label,
            "steps": point.setting.steps or "",
            "error_at_end_rad": _number(point.error),
            "largest_error_rad": _number(point.largest),
            "gamma_error_at_end_rad": _number(point.gamma),
            "median_ms": _number(1e3 * point.time),
            "min_ms": _number(1e3 * min(point.seconds)) if point.seconds else "",
            "failed": point.failed,
        }
        for point in curve.points
        if point.seconds or point.failed
    ]


def _reached(
    engine: str, method: str, found: Reached, results: Results, target: float
) -> dict[str, Any]:
    return {
        "engine": engine,
        "method": method or "best of all",
        "error_rad": target,
        "ms": None if found.time is None else 1e3 * found.time,
        "interpolated_ms": None if found.between is None else 1e3 * found.between,
        "setting": None if found.point is None else found.point.setting.label,
        "over_ours": results.ratio(found, target),
    }


def _cell(results: Results, found: Reached, target: float) -> str:
    if found.time is None:
        return "-"
    ratio = results.ratio(found, target)
    beside = "" if ratio is None else f" ({_rounded(ratio)} x)"
    return f"{1e3 * found.time:.3g}{beside}"


def _rounded(ratio: float) -> str:
    return f"{ratio:.2g}" if ratio < 10 else f"{float(f'{ratio:.2g}'):,.0f}"


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else ""


def _text(cells: list[list[str]]) -> str:
    return str(DataFrame(cells[1:], columns=cells[0]).to_string(index=False))
