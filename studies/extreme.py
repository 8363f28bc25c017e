# SPDX-License-Identifier: Apache-2.0
"""The page of stability: extreme cases, largest stable steps and stability regions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path

from sst_ros.integration.codegen import numba_version
from sst_ros.report.results import data_frame, markdown, provenance, publish, records
from studies import DOCS, run, run_jobs
from studies import extreme_runs as runs
from studies import stability_limits as limits
from studies.extreme_cases import LOOSE, catalogue
from studies.extreme_runs import BATCH_TOLERANCE, FACTOR, LOOSER, SAME_ORIENTATION, CaseResult
from studies.stability_limits import LargestStep

INTRODUCTION = f"""\
# Stability

Written by `python -m studies.extreme --long`; all figures are from the machine and the
date below. Without `--long` the cases of 1e5 s and of a thousand contacts are left out.

Each case is run by `Simulation` interpreted, a control period a call; through the run loop of the
simulator node; and compiled, in as few calls as possible. It passes if its result is that of theory
within the bound, or the named error where the motion must end, and if all runs end in the same
bits. The column "batch" is a run by `Batch` with DOP853, a step a control period, in which all
cases with the same terms are scenarios of one batch: it must have the bits of fixed steps of the
case's own scene, and where its local error estimate stays below {BATCH_TOLERANCE:g} the end of the
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


def report(out: Path, *, long: bool = False) -> bool:
    """Run all cases, find the largest steps, print it all and write it into `out`.

    Files: stability.csv, .json, .md, and stability_regions.png. With `long` the cases that
    take minutes even compiled are run, too. The result is whether every case passed.
    """
    jobs = [number for number, case in enumerate(catalogue()) if long or not case.compiled_only]
    cases = with_batches(run_jobs(_evaluate, jobs[::-1], "extreme cases   ")[::-1])
    steps = limits.largest_steps(progress="largest steps   ")
    print(page(cases, steps))
    table = data_frame(asdict(case) | {"passed": case.passed} for case in cases)
    found = records(data_frame(step._asdict() for step in steps))
    regions = limits.draw_regions(limits.scene_points(), provenance())
    publish(
        out, "stability", csv=table, page=page(cases, steps),
        document={"cases": records(table), "largest_stable_steps": found},
        figures={"stability_regions": regions},
    )  # fmt: skip
    return all(case.passed for case in cases)


def _evaluate(number: int) -> CaseResult:
    return runs.evaluate_case(catalogue()[number])


def with_batches(cases: Sequence[CaseResult]) -> list[CaseResult]:
    """Add to results of cases those of the batches that they are scenarios of."""
    if numba_version() is None:
        return list(cases)
    groups = runs.batch_groups(catalogue())
    names = [catalogue()[number].name for number in chain.from_iterable(groups)]
    found = chain.from_iterable(run_jobs(_batched, groups, "batches         "))
    rows = dict(zip(names, found, strict=True))
    return [
        replace(case, batch=words, correct=case.correct and agrees)
        for case in cases
        for words, agrees in [rows.get(case.name, ("", True))]
    ]


def _batched(group: tuple[int, ...]) -> list[tuple[str, bool]]:
    return runs.run_batch([catalogue()[number] for number in group])


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
              *(f"- {line}." for line in limits.limits_of_theory()), ""]  # fmt: skip
    parts += ["## Largest stable steps", "",
              "In milliseconds, in brackets times the largest modulus of the eigenvalues. The "
              "damped family is `stiff` with other viscous coefficients [N m s/rad]; the "
              "oscillating one is the star of `example2_heavy` on springs [N m/rad]. A step "
              "counts as stable if rates do not grow tenfold in 400 steps: growth as weak as that "
              "of dopri5 on the imaginary axis beyond 0.997 i is not seen.", ""]  # fmt: skip
    for family in ("decay", "oscillation"):
        parts += [f"### {family.capitalize()}", "", markdown(limits.step_table(steps, family)), ""]
    parts += ["## Cases", ""]
    for group in dict.fromkeys(case.group for case in cases):
        own = [case for case in cases if case.group == group]
        parts += [f"### {group}", "", markdown(data_frame(map(_row, own))), ""]
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


def main(words: Sequence[str] | None = None) -> int:
    """Run the catalogue from the command line."""
    long = {"action": "store_true", "help": "the cases that take minutes, too"}
    return run(lambda given: report(given.out, long=given.long), "extreme", DOCS, words, long=long)


if __name__ == "__main__":
    raise SystemExit(main())
