# SPDX-License-Identifier: Apache-2.0
"""What the study found, as tables, in the pages that show it, as CSV and as JSON.

`python -m benchmark.peers.results` brings the README's table up to date from docs/peers.json.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from pandas import DataFrame

from benchmark.measure import (
    DOCS,
    describe_machine,
    fill,
    fill_page,
    format_markdown,
    join_line,
    write_json,
)
from benchmark.peers.floor import Floor
from benchmark.peers.ours import ENGINE as OURS
from benchmark.peers.ours import PUBLIC
from benchmark.peers.study import TARGETS, Curve, Reached, Reference, reach

PACKAGES = ("numpy", "numba", "mujoco", "pin", "drake", "exudyn", "scipy", "mpmath")

CLAIMS = (
    ("MuJoCo", "", "MuJoCo's best setting", {1e-6: 1000, 1e-9: 2000}),
    ("Pinocchio", "RK4", "Pinocchio in a loop of RK4 in Python", {1e-6: 300, 1e-9: 800}),
    ("Pinocchio", "", "Pinocchio under our DOP853 in Python", {1e-6: 300, 1e-9: 800}),
    ("SciPy on the paper's form", "", "SciPy on the NumPy form", {1e-6: 10000, 1e-9: 10000}),
)
"""Engine, begin of the method's name, what it is called, and the target ratio by error."""

README = DOCS.parent / "README.md"
README_ROWS = {
    "sst_ros": "sst_ros, {}",
    "MuJoCo": "MuJoCo, best setting",
    "Pinocchio": "Pinocchio, DOP853 in a Python loop",
    "SciPy on the paper's form": "SciPy on the paper's equations in NumPy",
}
Rows = list[list[str]]
"""Cells of a table, heads first."""


@dataclass
class Results:
    """Everything that is reported about a study."""

    curves: list[Curve]
    missing: dict[str, str]
    reference: Reference
    rounds: int
    quick: bool
    seconds: float
    floor: Floor
    machine: dict[str, str] = field(default_factory=lambda: describe_machine(*PACKAGES))

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
        return reach([c for c in curves if c.series.name.startswith(method)], target)

    def ratio(self, other: Reached, target: float) -> float | None:
        """How many times faster we reach it: median of the quotients of each round."""
        ours = self.best(OURS, target).point
        if ours is None or other.point is None:
            return None
        return median(a / b for a, b in zip(other.point.seconds, ours.seconds, strict=True))

    def cell(self, found: Reached, target: float) -> str:
        """Time [ms], and how many times ours that is."""
        ratio = self.ratio(found, target)
        if found.time is None:
            return "-"
        return f"{1e3 * found.time:.3g}" + ("" if ratio is None else f" ({_round(ratio)} x)")

    def series_rows(self) -> Rows:
        """A row a series."""
        found = [["engine", "method", "Python runs", "gate", *_heads(TARGETS)]]
        for curve in self.curves:
            series = curve.series
            gate = f"{curve.gate:.0e}" if curve.passed else f"{curve.gate:.0e} FAILED"
            cells = [self.cell(reach([curve], target), target) for target in TARGETS]
            found.append([series.engine, series.name, series.python, gate, *cells])
        return found

    def best_rows(self) -> Rows:
        """The best of each engine."""
        found = [["engine, best of all settings", *_heads(TARGETS)]]
        for engine in self.engines:
            cells = [self.cell(self.best(engine, target), target) for target in TARGETS]
            found.append([engine, *cells])
        return found + [[engine, *["not installed"] * len(TARGETS)] for engine in self.missing]

    def floor_rows(self) -> Rows:
        """What a program that evaluates one acceleration at a time can do at most, and peers."""
        counts, cost = self.floor.evaluations, self.floor.seconds
        found = [["", *_heads(counts)], ["evaluations, at least", *map(str, counts.values())]]
        if cost is None:
            return found
        times = {t: n * cost for t, n in counts.items()}
        found.append(["in C [ms]", *(f"{1e3 * x:.3g}" for x in times.values())])
        for engine in self.engines:
            own = {target: self.best(engine, target).time for target in times}
            cells = ["-" if x is None else f"{_round(x / times[t])} x" for t, x in own.items()]
            found.append([f"{engine} over that", *cells])
        return found

    def verdicts(self) -> list[str]:
        """One sentence for each claim on an engine that is here."""
        found = []
        for engine, method, name, targets in CLAIMS:
            for target, asked in targets.items() if engine in self.engines else ():
                ratio = self.ratio(self.best(engine, target, method), target)
                verdict = f"{name}: not reached by any setting (target {asked:,})"
                if ratio is not None:
                    met = "met" if ratio >= asked else "NOT met"
                    verdict = f"{_round(ratio)} times faster than {name} (target {asked:,}: {met})"
                found.append(f"{target:.0e} rad: {verdict}")
        return found

    def settings(self) -> list[str]:
        """The settings behind the best times of each engine."""
        lines = []
        for engine in self.engines:
            parts = []
            for target in TARGETS:
                point = self.best(engine, target).point
                if point is not None:
                    method = next(c.series.name for c in self.curves if point in c.points)
                    parts.append(f"{target:.0e} rad: {method}, {point.setting.label}")
            lines.append(f"{engine}: {'; '.join(parts) or 'none'}")
        return lines

    def run(self) -> str:
        """How the study was run."""
        return (
            f"{sum(len(curve.points) for curve in self.curves)} settings, {self.rounds} rounds; "
            f"reference: {self.reference.how}, own error {self.reference.error:.0e} rad.\n"
            f"{join_line(self.machine)}. {'A quick, smaller sweep. ' if self.quick else ''}"
            f"The whole took {self.seconds:.0f} s."
        )

    def missing_lines(self) -> list[str]:
        """Why engines are missing."""
        return [f"{engine}: {why}." for engine, why in self.missing.items()]


def write_table(results: Results) -> str:
    """Text for the terminal."""
    texts = [
        str(DataFrame(rows[1:], columns=rows[0]).to_string(index=False))
        for rows in (results.series_rows(), results.best_rows(), results.floor_rows())
    ]
    head = (
        "One second of Example 2. Processor time [ms] to an error of the orientation at the end,\n"
        "and how many times that is ours. '-': not reached by any setting tried."
    )
    verdicts, missing = "\n".join(results.verdicts()), "\n".join(results.missing_lines())
    return "\n\n".join(
        [head, *texts[:2], verdicts, texts[2], "\n".join(filter(None, [results.run(), missing]))]
    )


def write(results: Results, folder: Path) -> None:
    """Write peers.md, peers.csv, one row a setting that was timed or failed, and peers.json."""
    rows = [row for curve in results.curves for row in _list_points(curve)]
    DataFrame(rows).to_csv(folder / "peers.csv", index=False, lineterminator="\n")
    curves = [(c.series.engine, c.series.name, [c]) for c in results.curves]
    document = {
        "machine": results.machine,
        "rounds": results.rounds,
        "quick": results.quick,
        "reference_error_rad": results.reference.error,
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
            _describe_reached(engine, "best of all", results.best(engine, target), results, target)
            for engine in results.engines
            for target in TARGETS
        ]
        + [
            _describe_reached(engine, method, reach(own, target), results, target)
            for engine, method, own in curves
            for target in TARGETS
        ],
        "verdicts": results.verdicts(),
        "floor": {
            "evaluations": {f"{t:.0e}": n for t, n in results.floor.evaluations.items()},
            "ns_of_one_in_c": results.floor.seconds and 1e9 * results.floor.seconds,
        },
    }
    write_json(folder / "peers.json", document)
    lines = ["The settings behind the best times:", "", *(f"- {x}." for x in results.settings())]
    missing = [line for text in results.missing_lines() for line in (text, "")]
    parts = {
        "best": format_markdown(results.best_rows()),
        "verdicts": "\n".join(f"- {line}." for line in results.verdicts()),
        "floor": format_markdown(results.floor_rows()),
        "series": format_markdown(results.series_rows()),
        "settings": "\n".join([*missing, *lines]),
        "run": results.run(),
    }
    fill_page(DOCS / "peers.md", parts, folder / "peers.md")


def _list_points(curve: Curve) -> list[dict[str, Any]]:
    return [
        {
            "engine": curve.series.engine,
            "method": curve.series.name,
            "setting": point.setting.label,
            "steps": point.setting.steps or "",
            "error_at_end_rad": _format(point.error),
            "largest_error_rad": _format(point.largest),
            "gamma_error_at_end_rad": _format(point.gamma),
            "median_ms": _format(1e3 * point.time),
            "min_ms": _format(1e3 * min(point.seconds)) if point.seconds else "",
            "failed": point.failed,
        }
        for point in curve.points
        if point.seconds or point.failed
    ]


def _describe_reached(
    engine: str, method: str, found: Reached, results: Results, target: float
) -> dict[str, Any]:
    return {
        "engine": engine,
        "method": method,
        "error_rad": target,
        "ms": None if found.time is None else 1e3 * found.time,
        "interpolated_ms": None if found.between is None else 1e3 * found.between,
        "setting": None if found.point is None else found.point.setting.label,
        "over_ours": results.ratio(found, target),
    }


def _heads(targets: Any) -> list[str]:
    return [f"{target:.0e} rad" for target in targets]


def _round(ratio: float) -> str:
    return f"{ratio:.2g}" if ratio < 10 else f"{float(f'{ratio:.2g}'):,.0f}"


def _format(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else ""


def fill_readme(text: str, results: dict[str, Any]) -> str:
    """Return the text of the README with processor times of the best settings, over ours."""
    best = {
        (row["engine"], row["error_rad"]): row
        for row in results["reached"]
        if row["method"] == "best of all"
    }

    def cell(row: dict[str, Any] | None) -> str:
        if row is None or row["ms"] is None:
            return "-"
        time, ratio = (float(f"{row[key]:.2g}") for key in ("ms", "over_ours"))
        return f"{time:g} ms" + ("" if ratio == 1.0 else f" ({ratio:,.0f} x)")

    date = results["machine"]["date"][:10]
    lines = [f"| Example 2, one second, {date} | to 1e-6 rad | to 1e-9 rad |"]
    lines.append("| --- | ---: | ---: |")
    for engine, name in README_ROWS.items():
        cells = " | ".join(cell(best.get((engine, target))) for target in (1e-6, 1e-9))
        lines.append(f"| {name.format('a run of `prepare`')} | {cells} |")
    return fill(text, {"speed": "\n".join(lines)})


def write_readme() -> None:
    """Bring the README up to date."""
    results = json.loads((DOCS / "peers.json").read_text(encoding="utf-8"))
    text = fill_readme(README.read_text(encoding="utf-8"), results)
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_readme()
