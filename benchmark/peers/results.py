# SPDX-License-Identifier: Apache-2.0
"""What the study found, as tables, in the pages that show it, as CSV, as JSON and as a
picture.

`python -m benchmark.peers.results` draws the picture and brings the README's table up
to date from docs/peers.csv and docs/peers.json.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchmark.measure import DOCS, describe_machine, fill, fill_page, join_line
from benchmark.peers.floor import Floor
from benchmark.peers.ours import ENGINE as OURS
from benchmark.peers.ours import PUBLIC
from benchmark.peers.study import TARGETS, Curve, Point, Reference, reach
from sst_ros.figures import BLUE, GREEN, INK, VERMILION, Looks, save_figure, styled
from sst_ros.report.results import markdown

PACKAGES = ("numpy", "llvmlite", "mujoco", "pin", "casadi", "scipy", "mpmath")

README = DOCS.parent / "README.md"
README_ROWS = {
    "sst_ros": "sst_ros, `simulate` with its samples",
    "MuJoCo": "MuJoCo, best setting",
    "Pinocchio": "Pinocchio, best setting",
    "CasADi": "The same equations by CasADi, in C",
    "SciPy on the paper's form": "SciPy on the paper's equations in NumPy",
}
PURPLE = "#CC79A7"
"""Of the palette of Okabe and Ito, as the other colours."""

STYLES = {
    "sst_ros": (BLUE, "o"),
    "MuJoCo": (VERMILION, "s"),
    "Pinocchio": (GREEN, "D"),
    "CasADi": (PURPLE, "^"),
    "SciPy on the paper's form": (INK, "P"),
}
"""Colour and marker of each engine, in the order of the legend."""
SMALLEST, LARGEST = 2e-14, 1.0
"""Range of the errors in the picture [rad]."""


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

    def best(self, engine: str, target: float) -> Point | None:
        """Return the setting by which an engine reaches an error soonest.

        Ours is the public call alone, overhead included.
        """
        method = PUBLIC if engine == OURS else ""
        curves = [c for c in self.curves if c.series.engine == engine]
        return reach([c for c in curves if c.series.name.startswith(method)], target)

    def ratio(self, other: Point | None, target: float) -> float | None:
        """How many times faster we reach it: median of the quotients of each round."""
        ours = self.best(OURS, target)
        if ours is None or other is None:
            return None
        return median(a / b for a, b in zip(other.seconds, ours.seconds, strict=True))

    def cells(self, found: Iterable[Point | None]) -> dict[str, str]:
        """Time to each target [ms], and how many times ours that is."""
        cells = {}
        for target, point in zip(TARGETS, found, strict=True):
            ratio = self.ratio(point, target)
            text = "-" if point is None else f"{1e3 * point.time:.3g}"
            cells[_head(target)] = text + (
                "" if ratio is None else f" ({_round(ratio)} x)"
            )
        return cells

    def tables(self) -> dict[str, pd.DataFrame]:
        """All series, the best of each engine, and those beside the floor, by name of
        the part.
        """
        series = []
        for curve in self.curves:
            one, failed = curve.series, "" if curve.passed else " FAILED"
            head = {"engine": one.engine, "method": one.name, "Python runs": one.python}
            cells = self.cells(reach([curve], target) for target in TARGETS)
            series.append({**head, "gate": f"{curve.gate:.0e}{failed}", **cells})
        name, best = "engine, best of all settings", []
        for engine in self.engines:
            cells = self.cells(self.best(engine, target) for target in TARGETS)
            best.append({name: engine, **cells})
        absent = dict.fromkeys(map(_head, TARGETS), "not installed")
        best += [{name: engine, **absent} for engine in self.missing]
        rows = {"series": series, "best": best, "floor": self._list_floor()}
        return {part: pd.DataFrame(listed) for part, listed in rows.items()}

    def _list_floor(self) -> list[dict[str, str]]:
        """What a program that evaluates one acceleration at a time can do at most, and
        peers.
        """
        counts, cost = self.floor.evaluations, self.floor.seconds
        rows = [
            {
                "": "evaluations, at least",
                **{_head(t): str(n) for t, n in counts.items()},
            }
        ]
        if cost is None:
            return rows
        times = {target: count * cost for target, count in counts.items()}
        rows.append(
            {"": "in C [ms]", **{_head(t): f"{1e3 * x:.3g}" for t, x in times.items()}}
        )
        for engine in self.engines:
            own = {target: self.best(engine, target) for target in times}
            cells = {_head(t): "-" if p is None else f"{_round(p.time / times[t])} x"
                     for t, p in own.items()}  # fmt: skip
            rows.append({"": f"{engine} over that", **cells})
        return rows

    def settings(self) -> list[str]:
        """The settings behind the best times of each engine."""
        lines = []
        for engine in self.engines:
            parts = []
            for target in TARGETS:
                point = self.best(engine, target)
                if point is not None:
                    method = next(
                        c.series.name for c in self.curves if point in c.points
                    )
                    parts.append(f"{_head(target)}: {method}, {point.setting.label}")
            lines.append(f"{engine}: {'; '.join(parts) or 'none'}")
        return lines

    def run(self) -> str:
        """How the study was run."""
        return (
            f"{sum(len(curve.points) for curve in self.curves)} settings, {self.rounds}"
            f" rounds; reference: {self.reference.how}, own error"
            f" {self.reference.error:.0e} rad.\n{join_line(self.machine)}."
            f" {'A quick, smaller sweep. ' if self.quick else ''}The whole took"
            f" {self.seconds:.0f} s."
        )

    def parts(self) -> dict[str, str]:
        """The parts of the page by name, Markdown."""
        missing = [f"{engine}: {why}.\n" for engine, why in self.missing.items()]
        lines = [
            "The settings behind the best times:\n",
            *(f"- {x}." for x in self.settings()),
        ]
        return {part: markdown(rows) for part, rows in self.tables().items()} | {
            "settings": "\n".join([*missing, *lines]),
            "run": self.run(),
        }


def write(results: Results, folder: Path) -> None:
    """Write peers.md, .png, .csv, a row for each setting timed or failed, and
    peers.json.
    """
    rows = [row for curve in results.curves for row in _list_points(curve)]
    pd.DataFrame(rows).to_csv(folder / "peers.csv", index=False, lineterminator="\n")
    best = [
        (engine, "best of all", partial(results.best, engine))
        for engine in results.engines
    ]
    best += [
        (c.series.engine, c.series.name, partial(reach, [c])) for c in results.curves
    ]
    reached = []
    for engine, method, find in best:
        for target in TARGETS:
            point = find(target)
            row: dict[str, Any] = {
                "engine": engine,
                "method": method,
                "error_rad": target,
            }
            row["ms"] = None if point is None else 1e3 * point.time
            row["setting"] = None if point is None else point.setting.label
            reached.append({**row, "over_ours": results.ratio(point, target)})
    document = {
        "machine": results.machine,
        "reference_error_rad": results.reference.error,
        "gates": {
            f"{c.series.engine}: {c.series.name}": c.gate for c in results.curves
        },
        "reached": reached,
        "floor": {
            "evaluations": {
                f"{t:.0e}": n for t, n in results.floor.evaluations.items()
            },
            "ns_of_one_in_c": results.floor.seconds and 1e9 * results.floor.seconds,
        },
    }
    text = json.dumps(document, indent=1, ensure_ascii=False)
    (folder / "peers.json").write_text(text + "\n", encoding="utf-8")
    fill_page(DOCS / "peers.md", results.parts(), folder / "peers.md")
    draw(folder)


def _list_points(curve: Curve) -> list[dict[str, Any]]:
    return [
        {
            "engine": curve.series.engine,
            "method": curve.series.name,
            "setting": point.setting.label,
            "steps": point.setting.steps or "",
            "error_at_end_rad": _format(point.error),
            "gamma_error_at_end_rad": _format(point.gamma),
            "median_ms": _format(1e3 * point.time),
            "min_ms": _format(1e3 * min(point.seconds)) if point.seconds else "",
            "failed": point.failed,
        }
        for point in curve.points
        if point.seconds or point.failed
    ]


def _head(target: float) -> str:
    return f"{target:.0e} rad"


def _round(ratio: float) -> str:
    return f"{ratio:.2g}" if ratio < 10 else f"{float(f'{ratio:.2g}'):,.0f}"


def _format(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else ""


@styled
def draw(folder: Path) -> None:
    """Write peers.png beside peers.csv and peers.json.

    A thin curve with a number is a method; thick is the best, of sst_ros the public
    call.
    """
    rows = pd.read_csv(folder / "peers.csv")
    rows = rows[rows.median_ms.notna() & rows.failed.isna()]
    machine = json.loads((folder / "peers.json").read_text(encoding="utf-8"))["machine"]
    note = f"{machine['processor']}, one core, {machine['date']}."
    figure = Figure(figsize=(10.5, 5.4), layout="constrained")
    axes = figure.subplots()
    number = 0
    for engine, (colour, marker) in STYLES.items():
        own = rows[rows.engine == engine]
        public = own[own.method.str.startswith(PUBLIC)]
        best, what = (own, "best of all") if public.empty else (public, f"by {PUBLIC}")
        label = f"{engine}, {what}" if len(own) else ""
        looks: Looks = {"marker": marker, "markersize": 5, "zorder": 3, "label": label}
        axes.plot(*find_front(best), color=colour, **looks)
        for method, group in own.drop(public.index).groupby("method"):
            (times, errors), number = find_front(group), number + 1
            looks = {"linewidth": 1.0, "alpha": 0.4, "label": f"{number}  {method}"}
            axes.plot(times, errors, color=colour, **looks)
            # these end together
            height = 4 - 7 * (number % 3) if errors[-1] > 1e-4 else -3
            beside: Looks = {
                "textcoords": "offset points",
                "fontsize": 8,
                "color": colour,
            }
            axes.annotate(str(number), (times[-1], errors[-1]), (3, height), **beside)
    for error in (1e-6, 1e-9):  # which the tables name
        axes.axhline(
            error, color="#666666", linewidth=0.8, linestyle=(0, (6, 4)), zorder=1
        )
    axes.set(xscale="log", yscale="log", ylim=(0.5 * SMALLEST, LARGEST))
    axes.set_xlabel("processor time of one simulated second [ms], median")
    axes.set_ylabel("error of the orientation at t = 1 s [rad]")
    axes.set_title("Work-precision diagram: Example 2 of the paper", loc="left")
    figure.legend(loc="outside right upper", fontsize=8.5)
    figure.supxlabel(note, fontsize=8.5, color="#444444")
    save_figure(figure, folder / "peers.png")


def find_front(rows: pd.DataFrame) -> tuple[list[float], list[float]]:
    """Times [ms] and errors [rad] that no faster one is as accurate as, in order of
    time.
    """
    sorted_rows = rows.sort_values(["median_ms", "error_at_end_rad"])
    best = sorted_rows[sorted_rows.error_at_end_rad.cummin().diff().fillna(-1.0) < 0.0]
    return best.median_ms.tolist(), best.error_at_end_rad.clip(lower=SMALLEST).tolist()


def fill_readme(text: str, results: dict[str, Any]) -> str:
    """Return the text of the README with processor times of the best settings, over
    ours.
    """
    best = {
        (row["engine"], row["error_rad"]): row
        for row in results["reached"]
        if row["method"] == "best of all"
    }

    def cell(row: dict[str, Any] | None) -> str:
        if row is None or row["ms"] is None:
            return "-"
        time, ratio = float(f"{row['ms']:.2g}"), row["over_ours"]
        return f"{time:g} ms" + ("" if ratio == 1.0 else f" ({_round(ratio)} x)")

    date = results["machine"]["date"][:10]
    lines = [f"| Example 2, one second, {date} | to 1e-6 rad | to 1e-9 rad |"]
    lines.append("| --- | ---: | ---: |")
    for engine, name in README_ROWS.items():
        if not any((engine, target) in best for target in (1e-6, 1e-9)):
            continue  # it was not in that run
        cells = " | ".join(cell(best.get((engine, target))) for target in (1e-6, 1e-9))
        lines.append(f"| {name} | {cells} |")
    return fill(text, {"speed": "\n".join(lines)})


def write_readme() -> None:
    """Bring the README up to date."""
    results = json.loads((DOCS / "peers.json").read_text(encoding="utf-8"))
    text = fill_readme(README.read_text(encoding="utf-8"), results)
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    draw(DOCS)
    write_readme()
