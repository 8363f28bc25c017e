# SPDX-License-Identifier: Apache-2.0
"""The stability report: extreme cases, largest stable steps and stability regions, as one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

from sst_ros.integration.codegen import numba_version
from sst_ros.plot.methods import draw_regions
from sst_ros.report.results import provenance, records, table, write
from sst_ros.report.stability import regions
from sst_ros.sweeps.job_list import run_jobs
from studies import DOCS, geometry_cases, load_cases, parser, run, scaling_cases
from studies.extreme_batches import batch_groups, run_batch
from studies.extreme_cases import Case
from studies.extreme_results import CaseResult, evaluate_case
from studies.stability_limits import LONGEST_S, draw_largest_steps, largest_steps, scene_points
from studies.stability_page import case_table, faults, lines, page


def report(out: Path, *, workers: int | None = None, long: bool = False) -> bool:
    """Run all cases, find the largest steps, print it all and write it into `out`.

    Files: stability.csv, .json, .md, .png, and stability_regions.png.

    Args:
        out: folder of the files.
        workers: processes; None for one a core.
        long: run the cases that take minutes even compiled, too.

    Returns:
        Whether every case passed, and the coefficients of every method meet their conditions.

    Raises:
        InputError: `out` cannot be written.

    """
    jobs = [number for number, case in enumerate(catalogue()) if long or not case.compiled_only]
    cases = run_jobs(_evaluated, jobs[::-1], "extreme cases   ", workers)[::-1]
    cases = with_batches(cases, workers)
    steps = largest_steps(workers=workers, progress="largest steps   ")
    print("\n".join(lines(cases, steps)))
    x, y, growth = regions()
    write(
        out, "stability", csv=case_table(cases),
        document={
            "cases": records(case_table(cases)),
            "largest_stable_steps": records(table(map(asdict, steps))),
        },
        page=page(cases, steps),
        figures={
            "stability": draw_largest_steps(table(map(asdict, steps)), LONGEST_S, provenance()),
            "stability_regions": draw_regions(x, y, growth, scene_points(), provenance()),
        },
    )  # fmt: skip
    return all(case.passed for case in cases) and not list(faults())


GROUPS = (
    ("Time scales", scaling_cases.scaled_times, "rates over twelve decades"),
    ("Inertia scales", scaling_cases.scaled_inertias, "numbers far from 1, or from each other"),
    ("Violent motion", scaling_cases.violent, "accelerations of 1e8 rad/s^2, rates of 1e6 rad/s"),
    ("Starts at limits", scaling_cases.starts, "a joint at its limit, where a sign decides"),
    ("Stiff loads", scaling_cases.stiff, "decay rates far above those of the motion"),
    ("Parallel singularities", geometry_cases.parallel_singularities, ""),
    ("Edges of the workspace", geometry_cases.edges, ""),
    ("Poles and unusual shapes", geometry_cases.shapes, ""),
    ("Friction and actuators", load_cases.friction, ""),
    ("Compliant stops", load_cases.contacts, ""),
    ("Torques that jump", load_cases.jumps, ""),
    ("Extreme ratios of inertia", scaling_cases.ratios, ""),
    ("Long runs", load_cases.long_runs, ""),
)
"""Headings of the page, the cases below each, and why they are hard where a case names nothing."""


@lru_cache(maxsize=1)
def catalogue() -> tuple[Case, ...]:
    """Return all cases."""
    return tuple(
        replace(case, group=group, difficulty=case.difficulty or difficulty)
        for group, cases, difficulty in GROUPS for case in cases()
    )  # fmt: skip


def _evaluated(number: int) -> CaseResult:
    return evaluate_case(catalogue()[number])


def with_batches(cases: Sequence[CaseResult], workers: int | None) -> list[CaseResult]:
    """Add to results of cases those of the batches that they are scenarios of."""
    if numba_version() is None:
        return list(cases)
    groups = batch_groups(catalogue())
    found = run_jobs(_batched, groups, "batches         ", workers)
    rows = {
        catalogue()[number].name: row
        for group, found_rows in zip(groups, found, strict=True)
        for number, row in zip(group, found_rows, strict=True)
    }
    return [
        replace(case, batch=words, correct=case.correct and agrees)
        for case in cases
        for words, agrees in [rows.get(case.name, ("", True))]
    ]


def _batched(group: tuple[int, ...]) -> list[tuple[str, bool]]:
    return run_batch([catalogue()[number] for number in group])


def main(words: Sequence[str] | None = None) -> int:
    """Run the catalogue from the command line."""
    arguments = parser("extreme", "Stiff and extreme cases, and largest stable steps.", DOCS)
    arguments.add_argument("--long", action="store_true", help="the cases that take minutes, too")
    arguments.add_argument("--workers", type=int, help="processes; default: one a core")
    return run(
        lambda options: report(options.out, workers=options.workers, long=options.long),
        arguments,
        words,
    )


if __name__ == "__main__":
    raise SystemExit(main())
