# SPDX-License-Identifier: Apache-2.0
"""The stability report as text: lines for the terminal, and a page of Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.integration.methods import METHODS, RODAS4
from sst_ros.report.results import markdown, provenance, table
from sst_ros.report.stability import FAR, stability_function
from studies.extreme_batches import SAME_ORIENTATION, TOLERANCE
from studies.extreme_cases import LOOSE
from studies.extreme_results import FACTOR, LOOSER, CaseResult
from studies.stability_limits import (
    LONGEST_S,
    LargestStep,
    method_faults,
)

if TYPE_CHECKING:
    from pandas import DataFrame

INTRODUCTION = f"""\
# Stability

Written by `python -m studies.extreme --long`; all figures are from the machine and the
date below. Without `--long` the cases of 1e5 s and of a thousand contacts are left out.

Each case is run by `Simulation` interpreted, a control period a call; through the run loop of the
simulator node; and compiled, in as few calls as possible. It passes if its result is that of theory
within the bound, or the named error where the motion must end, and if all runs end in the same
bits. The column "batch" is a run by `Batch` with DOP853, a step a control period, in which all
cases with the same terms are scenarios of one batch: it must have the bits of fixed steps of the
case's own scene, and where its local error estimate stays below {TOLERANCE:g} the end of the
simulation too, to {SAME_ORIENTATION:g}, or its limit within a step. Torques that read the state
cannot be a batch. Energy is the energy residual relative to the energy. Times include the making of
the scene, those of compiled runs compilation too; cases marked "compiled only" would take hours in
plain Python.

The error estimate must lie within a factor {FACTOR:g} of the true error, or the column "estimate"
gives the reason why there is nothing to compare. The case is run at the tolerance {LOOSE:g}, or at
{LOOSER:g} where an error is resolved only there, with steps as long as that allows, and compared
with its run at the default tolerance, 1e-10; a case that needs a finer one gives the reason. An
estimate of an error that is not resolved must not be above {FACTOR:g} times what is resolved.
"""


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
        yield f"{case.name}: {case.expected}; {case.result}; estimate: {case.check}"
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
    loops = sum(case.run_loop is not None for case in cases)
    batches = sum(bool(case.batch) for case in cases)
    checked = sum(case.loose_error is not None for case in cases)
    return (
        f"{len(cases)} cases, {failed} failed; {both} run interpreted and compiled, {loops} "
        f"through the run loop and {batches} as scenarios of a batch, with the same bits compared; "
        f"error estimate checked in {checked}, the others give the reason."
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
    parts += ["## Cases", ""]
    for group in dict.fromkeys(case.group for case in cases):
        own = [case for case in cases if case.group == group]
        parts += [f"### {group}", "", markdown(table(map(_row, own))), ""]
    return "\n".join([*parts, provenance(), ""])


def _row(case: CaseResult) -> dict[str, str]:
    def number(value: float | None, form: str = ".0e") -> str:
        return "-" if value is None else format(value, form)

    bits = {True: "same", False: "**differ**", None: "-"}
    return {
        "case": case.name,
        "why it is hard": case.difficulty,
        "truth": case.expected,
        "result": ("" if case.passed else "**FAILED** ") + case.result,
        "deviation (bound)": "-" if case.deviation is None
        else f"{case.deviation:.0e} ({case.bound:.0e})",
        "energy": number(case.energy),
        "true error": number(case.loose_error),
        "estimate": ("" if case.loose_estimate is None else f"{case.loose_estimate:.0e}: ")
        + case.check,
        "interpreted [s]": number(case.wall_s, ".2f") if case.wall_s else "compiled only",
        "compiled [s]": number(case.compiled_s, ".2f"),
        "bits compiled": bits[case.same_bits],
        "run loop": bits[case.run_loop],
        "batch": case.batch or "-",
    }  # fmt: skip
