# SPDX-License-Identifier: Apache-2.0
"""The stability report: extreme cases, largest stable steps and stability regions, as one page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.integration.methods import METHODS, RODAS4
from sst_ros.plot.stability import draw_largest_steps, draw_regions
from sst_ros.studies.extreme_cases import (
    FACTOR,
    LOOSE,
    WIDER_FACTOR,
    Case,
    CaseResult,
    evaluate_case,
)
from sst_ros.studies.geometry_cases import geometry_cases
from sst_ros.studies.load_cases import load_cases
from sst_ros.studies.results import markdown, provenance, records, table, write
from sst_ros.studies.scaling_cases import scaling_cases
from sst_ros.studies.stability_limits import (
    FAR,
    LONGEST_S,
    LargestStep,
    largest_steps,
    method_faults,
    regions,
    scene_points,
    stability_function,
)
from sst_ros.sweeps.job_list import run_jobs

if TYPE_CHECKING:
    from pandas import DataFrame

INTRODUCTION = f"""\
# Stability

Written by `python -m sst_ros report stability --long`; all figures are from the machine and the
date below. Without `--long` the cases of 1e5 s and of a thousand contacts are left out.

Each case is run by `Simulation` twice: interpreted, a control period a call, and compiled, in as
few calls as possible. It passes if its result is that of theory within the bound, or the named
error where the motion must end, and if both runs end in the same bits. Energy is the energy
residual relative to the energy. Times include the making of the scene, those of compiled runs
compilation too; cases marked "compiled only" would take hours in plain Python.

The error estimate must lie within a factor {FACTOR:g} of the true error, or {WIDER_FACTOR:g} where
a note below the table gives the reason. In the columns "true error" and
"estimate" [rad] the case is run at the tolerance {LOOSE:g}, with steps as long as that
allows, and compared with its run at the default tolerance, 1e-10. A dash means that the error is
not resolved: it is that of rounding in both.
"""


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


@lru_cache(maxsize=1)
def catalogue() -> tuple[Case, ...]:
    """Return all cases."""
    return (*scaling_cases(), *geometry_cases(), *load_cases())


def _evaluated(number: int) -> CaseResult:
    return evaluate_case(catalogue()[number])


def case_table(cases: Sequence[CaseResult]) -> DataFrame:
    """Return a row for each case."""
    return table(asdict(case) | {"passed": case.passed} for case in cases)


def step_table(steps: Sequence[LargestStep], family: str) -> DataFrame:
    """Return the largest stable steps of a family as texts: step [ms], step times abs(lambda)."""
    rows: dict[float, dict[str, str]] = {}
    for each in (step for step in steps if step.family == family):
        row = rows.setdefault(each.coefficient, {
            "coefficient": f"{each.coefficient:g}", "largest abs(lambda) [1/s]": f"{each.rate:.4g}",
        })  # fmt: skip
        row[each.method] = (
            f">= {1e3 * LONGEST_S:g}" if each.step >= LONGEST_S
            else f"{1e3 * each.step:.3g} ({each.step * each.rate:.2f})"
        )  # fmt: skip
    return table(rows.values())


def faults() -> Iterator[str]:
    """Yield what is wrong with the coefficients of the methods."""
    for name, method in METHODS.items():
        yield from (f"WARNING: {name}: {fault}" for fault in method_faults(method))


def limits_of_theory() -> Iterator[str]:
    """Yield where each method is stable on the axes, from its stability function."""
    for name, method in METHODS.items():
        if method is RODAS4:
            z = np.asarray(1j * np.geomspace(1e-3, 1e9, 100_000), dtype=np.complex128)
            on_axis = float(np.abs(stability_function(method, z)).max())
            far = abs(stability_function(method, np.array([FAR + 0j]))[0])
            yield (
                f"{name}: A-stable and L-stable; abs(R) is at most {on_axis:.15g} on the imaginary "
                f"axis, all poles lie at z = 4, and abs(R({FAR:g})) = {far:.0e}"
            )
            continue
        reach = []
        for direction in (-1.0, 1j):
            z = np.asarray(direction * np.linspace(0.0, 10.0, 100_001), dtype=np.complex128)
            modulus = np.abs(stability_function(method, z))
            outside = np.flatnonzero(modulus > 1.0 + 1e-9)
            reach.append(1e-4 * (outside[0] - 1) if len(outside) else math.inf)
        yield (
            f"{name}: stable for h lambda from -{reach[0]:.3f} to 0, and up to {reach[1]:.3f} i on "
            "the imaginary axis"
        )


def lines(cases: Sequence[CaseResult], steps: Sequence[LargestStep]) -> Iterator[str]:
    """Yield the report for the terminal line by line."""
    shown = case_table(cases).assign(passed=["yes" if case.passed else "FAILED" for case in cases])
    heads = {"name": "case", "passed": "passed", "deviation": "deviation", "bound": "bound",
             "energy": "energy", "loose_error": "true error", "loose_estimate": "estimate",
             "wall_s": "interpreted [s]", "compiled_s": "compiled [s]"}  # fmt: skip
    yield (
        shown[list(heads)]
        .rename(columns=heads)
        .to_string(
            index=False, na_rep="-", float_format=lambda x: f"{x:.1e}" if x < 0.01 else f"{x:.2f}"
        )
    )
    yield ""
    for case in cases:
        yield f"{case.name}: {case.expected}; {case.result}"
    yield ""
    yield summary(cases)
    for family in ("decay", "oscillation"):
        yield ""
        yield f"Largest stable step [ms] of the {family} family (step times largest abs(lambda))"
        yield step_table(steps, family).to_string(index=False)
    yield ""
    yield from limits_of_theory()
    yield from faults()
    yield ""
    yield provenance()


def summary(cases: Sequence[CaseResult]) -> str:
    """Count the cases in a sentence."""
    failed = sum(not case.passed for case in cases)
    both = sum(case.same_bits is not None for case in cases)
    checked = sum(case.loose_error is not None for case in cases)
    return (
        f"{len(cases)} cases, {failed} failed; {both} run interpreted and compiled with the same "
        f"bits compared; error estimate checked in {checked}."
    )


def page(cases: Sequence[CaseResult], steps: Sequence[LargestStep]) -> str:
    """Write the report as one Markdown page."""
    parts = [INTRODUCTION, f"**{summary(cases)}**", ""]
    parts += ["## Regions of absolute stability", "",
              "![regions of absolute stability](stability_regions.png)", "",
              "The marks are the eigenvalues of the linearised scenes at their start, times the "
              "step that `scene show` recommends.", "",
              *(f"- {line}." for line in (*limits_of_theory(), *faults())),
              "- Coefficients of all methods are checked against their order conditions, to 1e-12.",
              ""]  # fmt: skip
    parts += ["## Largest stable steps", "", "![largest stable steps](stability.png)", "",
              "In milliseconds, in brackets times the largest modulus of the eigenvalues. The "
              "damped family is `stiff` with other viscous coefficients [N m s/rad]; the "
              "oscillating one is the star of `example2_heavy` on springs [N m/rad]. A step "
              "counts as stable if rates do not grow tenfold in 400 steps: growth as weak as that "
              "of dopri5 on the imaginary axis beyond 0.997 i is not seen.", ""]  # fmt: skip
    for family in ("decay", "oscillation"):
        parts += [f"### {family.capitalize()}", "", markdown(step_table(steps, family)), ""]
    estimates = {case.name: case.estimate for case in catalogue()}
    parts += ["## Cases", ""]
    for group in dict.fromkeys(case.group for case in cases):
        own = [case for case in cases if case.group == group]
        parts += [f"### {group}", "", markdown(table(map(_row, own))), ""]
        notes = {case.name: estimates[case.name] for case in own if case.loose_error is not None}
        parts += [f"- {name}: {why}." for name, why in notes.items() if why] + [""]
    return "\n".join([*parts, provenance(), ""])


def _row(case: CaseResult) -> dict[str, str]:
    def number(value: float | None, form: str = ".0e") -> str:
        return "-" if value is None else format(value, form)

    return {
        "case": case.name,
        "why it is hard": case.difficulty,
        "truth": case.expected,
        "result": ("" if case.passed else "**FAILED** ") + case.result,
        "deviation (bound)": "-" if case.deviation is None
        else f"{case.deviation:.0e} ({case.bound:.0e})",
        "energy": number(case.energy),
        "true error": number(case.loose_error),
        "estimate": number(case.loose_estimate),
        "interpreted [s]": number(case.wall_s, ".2f") if case.wall_s else "compiled only",
        "compiled [s]": number(case.compiled_s, ".2f"),
        "bits": {True: "same", False: "**differ**", None: "-"}[case.same_bits],
    }  # fmt: skip
