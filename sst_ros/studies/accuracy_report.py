# SPDX-License-Identifier: Apache-2.0
"""The accuracy report: work-precision studies on the terminal, in files, and as one page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros import scene
from sst_ros.plot.work_precision import draw_work_precision
from sst_ros.studies.high_precision import EXTENDED
from sst_ros.studies.results import markdown, provenance, table, write
from sst_ros.studies.work_precision import (
    ABOVE_REFERENCE,
    SolverResult,
    WorkPrecision,
    work_precision,
)

if TYPE_CHECKING:
    from pandas import DataFrame

TARGET, TARGETS = 1e-9, (1e-6, 1e-9, 1e-12)
"""Orientation errors for which the fastest setting is named [rad]; TARGET is marked in figures."""

COLUMNS = (
    "scene", "method", "kind", "setting", "evaluations", "wall_min_s", "wall_median_s",
    "final_orientation_rad", "final_gamma_rad", "final_gamma_dot_rad_per_s",
    "largest_orientation_rad", "largest_gamma_rad", "largest_gamma_dot_rad_per_s",
    "energy_residual_J", "closure_residual", "below_floor", "failure",
)  # fmt: skip

INTRODUCTION = """\
# Accuracy and what it costs

Written by `python -m sst_ros report accuracy`; all figures are from the machine and the date below
the tables.

Every method solves the scene under its own torques, as continuous functions of time, and is
compared with a reference solution at twenty or more instants: DOP853 with fixed steps in extended
precision. The reference's own error is twice the difference of two step sizes; an error is plotted
only if it is 100 times larger than that. Times are of the integration alone, the shortest of
several runs, without compilation. Fixed steps use no error estimate. Tolerances include the coarse
solution that `Simulation` integrates for its estimate of the global error, three steps for each,
and one loop in Python around them. Compliant stops have kinks: fixed steps step over them, and
tolerances are given to `Simulation`, which locates each; it is the reference there too. Errors are
the largest over the run.

A setting is named as the fastest for a target only if every finer setting of the same method that
was tried, and at least one, reaches the target too. The advice is that of
`python -m sst_ros scene show`; where it was measured, the error of a `Simulation` that follows it
stands behind it.
"""


def report(
    names: Sequence[str], out: Path, *, kind: str = EXTENDED, compiled: bool = True
) -> list[WorkPrecision]:
    """Study scenes one after another; print each, and write all finished results into `out`.

    Files: accuracy.csv, accuracy.json, accuracy.md, accuracy_SCENE.png.

    Raises:
        SstError: a scene is refused or cannot start, or `out` cannot be written.

    """
    studies: list[WorkPrecision] = []
    for each in [scene.load(name) for name in names]:
        studies.append(work_precision(each, kind=kind, compiled=compiled, shown=True))
        print(text(studies[-1]), flush=True)
        write(
            out, "accuracy", csv=frame(studies), document={"studies": list(documents(studies))},
            page=page(studies), figures={f"accuracy_{each.name}": figure(studies[-1])},
        )  # fmt: skip
    return studies


def frame(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return the grids of all studies as one table, columns as in COLUMNS."""
    return table((row for study in studies for row in _rows(study)), COLUMNS)


def _rows(study: WorkPrecision) -> Iterator[dict[str, Any]]:
    for row in study.rows:
        final = (*asdict(row.final).values(),) if row.final else (None,) * 3
        largest = (*asdict(row.largest).values(),) if row.largest else (None,) * 3
        below = row.error < study.floor if row.largest else None
        values = (study.scene, row.method, row.kind, row.setting, row.evaluations, *row.wall_s,
                  *final, *largest, row.energy, row.closure, below, row.failure)  # fmt: skip
        yield dict(zip(COLUMNS, values, strict=True))


def documents(studies: Sequence[WorkPrecision]) -> Iterator[dict[str, Any]]:
    """Yield each study as JSON has it."""
    for study in studies:
        yield {
            "scene": study.scene,
            "seconds": study.seconds,
            "ends": study.ends,
            "compiled": study.compiled,
            "reference": study.reference.how,
            "reference_own_error": asdict(study.reference.own),
            "formulation_difference_relative": study.formulation,
            "advice": asdict(study.advice),
            "advice_measured_error_rad": study.measured and study.measured[0],
            "fastest": fastest(study),
            "warnings": list(study.warnings),
            "rows": list(_rows(study)),
        }


def fastest(study: WorkPrecision, target: float = TARGET) -> str:
    """Return the fastest setting for a target as a sentence."""
    best = study.best(target)
    if best is None:
        least = min((row.error for row in study.rows if row.largest), default=None)
        reached = "every one failed" if least is None else f"the least error is {least:.0e} rad"
        return (
            f"No setting that was tried reaches {target:.0e} rad with every finer one; {reached}."
        )
    return f"{target:.0e} rad over {study.seconds:g} s: {setting(best)}, {_time(best)}."


def setting(row: SolverResult) -> str:
    """Return method and setting in words."""
    if row.kind == "tolerance":
        return f"{row.method}, tolerance {row.setting:.0e}"
    return f"{row.method}, {1e3 * row.setting:g} ms steps"


def _time(row: SolverResult) -> str:
    milliseconds = 1e3 * row.wall_s[0]
    return f"{milliseconds:.2g} ms" if milliseconds < 99.5 else f"{milliseconds:.0f} ms"


def text(study: WorkPrecision) -> str:
    """Format a study for the terminal."""
    lines = [
        f"Accuracy of {study.scene} over {study.seconds:g} s"
        + (f" ({study.ends})" if study.ends else ""),
        *facts(study),
        "",
        *_grid(study),
        "",
    ]
    below = sum(row.error < study.floor for row in study.rows)
    if below:
        lines.append(f"* {below} rows lie below {study.floor:.0e} rad, 100 times the reference's "
                     "own error, and are not plotted.")  # fmt: skip
    lines += [f"WARNING: {warning}." for warning in study.warnings]
    lines += [fastest(study), provenance(compiled=study.compiled)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _grid(study: WorkPrecision) -> list[str]:
    heads = {
        "wall_min_s": "min [s]", "wall_median_s": "median [s]",
        "final_orientation_rad": "end [rad]", "largest_orientation_rad": "largest [rad]",
        "largest_gamma_rad": "gamma [rad]", "largest_gamma_dot_rad_per_s": "rate [rad/s]",
        "energy_residual_J": "energy [J]", "closure_residual": "closure",
    }  # fmt: skip
    shown = frame([study]).assign(setting=[setting(row) for row in study.rows])
    below = ["*" if row.error < study.floor else "" for row in study.rows]
    failure = [f"FAILED: {row.failure[:60]}" if row.failure else "" for row in study.rows]
    shown = shown[["setting", "evaluations", *heads]].rename(columns=heads)
    lines: str = shown.assign(**{"": below, "failure": failure}).to_string(
        index=False, na_rep="-", float_format=lambda x: f"{x:.1e}"
    )
    return lines.splitlines()


def facts(study: WorkPrecision) -> Iterator[str]:
    """Yield reference, formulation and advice, a sentence each."""
    own = study.reference.own
    yield (
        f"Reference: {study.reference.how}. Its own error: {own.orientation:.1e} rad, gamma "
        f"{own.gamma:.1e} rad, gamma_dot {own.gamma_dot:.1e} rad/s."
    )
    if study.formulation is not None:
        yield (
            "Kernel against the paper's equations, along the reference: "
            f"{study.formulation:.1e} of the largest acceleration."
        )
    measured = f" Measured: {study.measured[0]:.1e} rad." if study.measured else ""
    yield f"Advice: {study.advice.text}.{measured}"


def figure(study: WorkPrecision) -> Any:
    """Draw the study."""
    best = study.best(TARGET)
    return draw_work_precision(
        frame([study]),
        floors=(study.floor, ABOVE_REFERENCE * study.reference.own.gamma_dot),
        seconds=study.seconds,
        target=TARGET,
        best=None if best is None else (1e3 * best.wall_s[0], max(best.error, study.floor)),
        title=f"{study.scene}: error against wall time\n{fastest(study)}",
        footnote=f"Reference: {study.reference.how}. {provenance(compiled=study.compiled)}",
    )


def page(studies: Sequence[WorkPrecision]) -> str:
    """Write studies as one Markdown page."""
    rows = []
    for each in studies:
        best = {t: each.best(t) if t >= each.floor else None for t in TARGETS}
        cells = {f"{t:.0e} rad": f"{setting(b)}: {_time(b)}" if b else None
                 for t, b in best.items()}  # fmt: skip
        rows.append({"scene": each.scene, "run": f"{each.seconds:g} s", **cells})
    lines = [INTRODUCTION, "## Which method and step", "", markdown(table(rows))]
    for each in studies:
        lines += ["", f"## {each.scene}", "", f"**{fastest(each)}**", "",
                  f"![error against wall time, {each.scene}](accuracy_{each.scene}.png)",
                  ""]  # fmt: skip
        if each.ends:
            lines.append(f"- Compared over {each.seconds:g} s; the run ends there: {each.ends}.")
        lines += [f"- {fact}" for fact in facts(each)]
        failed = sum(bool(row.failure) for row in each.rows)
        if failed:
            lines.append(f"- {failed} of {len(each.rows)} settings failed; they are in the CSV "
                         "and in the figure.")  # fmt: skip
        lines += [f"- Warning: {warning}." for warning in each.warnings]
        lines.append(f"- {provenance(compiled=each.compiled)}")
    return "\n".join(lines) + "\n"
