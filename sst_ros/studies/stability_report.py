# SPDX-License-Identifier: Apache-2.0
"""The report of stability: the extreme cases and the largest steps, as text and in files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from sst_ros.output_folder import writing
from sst_ros.report.summary import made_on
from sst_ros.report.table import made_line
from sst_ros.studies.stability import LONGEST_S, Stable, Verdict, family, verdicts

TEXT, JSON, PICTURE = "stability.txt", "stability.json", "stability.png"


def report(out: Path) -> bool:
    """Judge the catalogue, find the largest steps, print it all and write it into `out`.

    Returns:
        Whether every case came out as it had to.

    Raises:
        InputError: `out` cannot be written.

    """
    from sst_ros.plot.stability import draw

    judged, steps = verdicts(shown=True), family(shown=True)
    made = {"report": made_on()}
    said = "\n".join(line.rstrip() for line in lines(judged, steps)) + f"\n\n{made_line(made)}\n"
    print(said, end="")
    document = {
        "cases": [asdict(verdict) for verdict in judged],
        "largest_stable_steps": [asdict(step) for step in steps],
        **made,
    }
    with writing(out, "report"):
        (out / TEXT).write_text(said, encoding="utf-8")
        (out / JSON).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
        draw(steps, made_line(made), out / PICTURE)
    return all(verdict.sound for verdict in judged)


def lines(judged: Sequence[Verdict], steps: Sequence[Stable]) -> Iterator[str]:
    """Yield the report line by line."""
    width = max((len(verdict.name) for verdict in judged), default=0) + 2
    yield (
        f"{'case':{width}}{'verdict':9}{'deviation':>11}{'allowed':>10}{'energy':>10}"
        f"{'closure':>10}{'time [s]':>10}  expected; what came"
    )
    for each in judged:
        numbers = (each.deviation, each.bound or None, each.energy, each.closure)
        cells = "".join("         -" if x is None else f"{x:10.1e}" for x in numbers)
        word = "sound" if each.sound else "WRONG"
        said = f"{each.expected}; {each.came}"
        yield f"{each.name:{width}}{word:9} {cells}{each.wall_s:10.2f}  {said}"
    wrong = sum(not each.sound for each in judged)
    yield ""
    yield f"{len(judged)} cases, {wrong} of them wrong. Energy is relative to what the run holds."
    yield ""
    methods = list(dict.fromkeys(step.method for step in steps))
    yield "Largest stable step [ms] of the stiff family, and times the fastest decay"
    heads = "".join(f"{name:>20}" for name in methods)
    yield f"{'viscosity [N m s/rad]':>22}{'decay [1/s]':>14}{heads}"
    for viscosity in dict.fromkeys(step.viscosity for step in steps):
        row = {step.method: step for step in steps if step.viscosity == viscosity}
        cells = "".join(f"{_step(row[name]):>20}" for name in methods)
        yield f"{viscosity:22g}{next(iter(row.values())).decay:14.4g}{cells}"


def _step(step: Stable) -> str:
    if step.step >= LONGEST_S:
        return f">= {1e3 * LONGEST_S:g}"
    return f"{1e3 * step.step:.3g} ({step.step * step.decay:.2f})"
