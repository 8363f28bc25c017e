# SPDX-License-Identifier: Apache-2.0
"""The accuracy report: work-precision studies on the terminal, in files, and as one page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.plot.methods import draw_summary, draw_work_precision
from sst_ros.report.reference_solution import EXTENDED
from sst_ros.report.results import markdown, provenance, records, table, write
from sst_ros.report.scene_summary import cost_table
from sst_ros.report.work_precision import (
    ABOVE_REFERENCE,
    ERROR,
    TOLERANCE,
    WorkPrecision,
    work_precision,
)
from sst_ros.scene import scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame, Series

TARGET, TARGETS = 1e-9, (1e-3, 1e-6, 1e-9, 1e-12)
"""Orientation errors for which the fastest setting is named [rad]; TARGET is in titles."""

AT_REST = "It rests: it has no torques of its own, a controller drives it along its motion."

INTRODUCTION = """\
# Accuracy and computing time

Written by `python -m sst_ros report accuracy --all`; all figures are from the machine and the date
below the tables. [Control rate and accuracy](control_rate.md) has the error of held torques.

Every method solves the scene under its own torques, as continuous functions of time, and is
compared with a reference solution at twenty or more instants: DOP853 with fixed steps in extended
precision. The reference's own error is twice the difference of two step sizes; an error is plotted
only if it is 100 times larger than that. Times are of the integration alone, the shortest of
several runs, without compilation. Fixed steps use no error estimate; those of Gauss collocation are
of a motion that was prepared. Tolerances include the coarse solution that `Simulation` integrates
for its estimate of the global error, three steps for each, and one loop in Python around them; for
Gauss collocation the search for its steps. Elastic stops have kinks: fixed steps step over them,
collocation does not take them, and tolerances are given to `Simulation`, which locates each; it is
the reference there too. Errors are the largest over the run.

A setting is named as the fastest for a target only if every finer setting of the same method that
was tried, and at least one, reaches the target too. The advice is what `simulate` takes with the
method "auto", as in `sst-ros scene show`; behind it stands the error that a run with it had.
"""

TERMS_INTRODUCTION = """\
Operations of the right-hand side are those of the scene, less those of the scene without the term;
times are of an evaluation in steps of RK4, with the step around it, the shortest of 200 turns that
both take. A term that folds into constants adds no operation. A compiler may need less time with a
term than without it.
"""


def report(
    names: Sequence[str], out: Path, *, kind: str = EXTENDED, compiled: bool = True
) -> list[WorkPrecision]:
    """Study scenes one after another; print each, and write all finished results into `out`.

    Files: accuracy.csv, .json, .md, .png, accuracy_SCENE.png, and accuracy_terms.csv.

    Raises:
        SstError: a scene is refused or cannot start, or `out` cannot be written.

    """
    studies: list[WorkPrecision] = []
    terms: list[dict[str, Any]] = []
    for each in [scene.load(name) for name in names]:
        studies.append(work_precision(each, kind=kind, compiled=compiled, shown=True))
        terms += cost_table(each, compiled=compiled)
        print(text(studies[-1]), flush=True)
        moves = not studies[-1].rests
        figures = {f"accuracy_{each.name}": figure(studies[-1])} if moves else {}
        if len(studies) == len(names):
            figures["accuracy"] = draw_summary(summary(studies), provenance(compiled=compiled))
        write(
            out, "accuracy", csv=frame(studies),
            document={"studies": list(documents(studies)), "terms": terms},
            page=page(studies, terms), figures=figures,
        )  # fmt: skip
    return studies


def frame(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return the grids of all studies as one table."""
    return table(row for study in studies for row in records(study.rows))


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
            "advice": study.advice._asdict(),
            "advice_measured_error_rad": study.measured and study.measured[0],
            "fastest": fastest(study),
            "warnings": list(study.warnings),
            "rows": records(study.rows),
        }


def summary(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return the fastest setting of each scene for each target: method, setting, time."""
    rows = []
    for study in studies:
        for target in TARGETS:
            best = study.best(target) if target >= study.floor else None
            if best is not None:
                rows.append({"scene": study.scene, "target": target, "method": best.method,
                             "setting": setting(best), "wall_s": best.wall_min_s,
                             "share": best.wall_min_s / study.seconds})  # fmt: skip
    return table(rows, ("scene", "target", "method", "setting", "wall_s", "share"))


def fastest(study: WorkPrecision, target: float = TARGET) -> str:
    """Return the fastest setting for a target as a sentence."""
    best = study.best(target)
    if study.rests:
        return AT_REST
    if best is None:
        errors = study.rows[ERROR].astype(float).dropna()
        reached = (
            "every one failed" if errors.empty else f"the least error is {errors.min():.0e} rad"
        )
        return (
            f"No setting that was tried reaches {target:.0e} rad with every finer one; {reached}."
        )
    return f"{target:.0e} rad over {study.seconds:g} s: {setting(best)}, {_time(best.wall_min_s)}."


def setting(row: Series[Any]) -> str:
    """Return method and setting in words."""
    if row.kind == TOLERANCE:
        return f"{row.method}, tolerance {row.setting:.0e}"
    return f"{row.method}, {1e3 * row.setting:.4g} ms steps"


def _time(wall_s: float) -> str:
    return f"{1e3 * wall_s:.2g} ms" if wall_s < 0.0995 else f"{1e3 * wall_s:.0f} ms"


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
    below = int((study.rows.below_floor == True).sum())  # noqa: E712
    if below:
        lines.append(f"* {below} rows lie below {study.floor:.0e} rad, 100 times the reference's "
                     "own error, and are not plotted.")  # fmt: skip
    lines += [f"WARNING: {warning}." for warning in study.warnings]
    lines += [fastest(study), provenance(compiled=study.compiled)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _grid(study: WorkPrecision) -> list[str]:
    heads = {
        "wall_min_s": "min [s]", "wall_median_s": "median [s]",
        "final_orientation_rad": "end [rad]", ERROR: "largest [rad]",
        "largest_gamma_rad": "gamma [rad]", "largest_gamma_dot_rad_per_s": "rate [rad/s]",
        "energy_residual_J": "energy [J]", "closure_residual": "closure",
    }  # fmt: skip
    shown = study.rows.assign(setting=[setting(row) for _, row in study.rows.iterrows()])
    below = ["*" if row is True else "" for row in study.rows.below_floor]
    failure = [f"FAILED: {reason[:60]}" if reason else "" for reason in study.rows.failure]
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


def figure(study: WorkPrecision) -> Figure:
    """Draw the study."""
    best = {target: study.best(target) for target in TARGETS if target >= study.floor}
    return draw_work_precision(
        study.rows,
        floors=(study.floor, ABOVE_REFERENCE * study.reference.own.gamma_dot),
        seconds=study.seconds,
        best={
            target: (1e3 * row.wall_min_s, max(row[ERROR], study.floor))
            for target, row in best.items()
            if row is not None
        },
        title=f"{study.scene}: error against wall time\n{fastest(study)}",
        footnote=f"Reference: {study.reference.how}. {provenance(compiled=study.compiled)}",
    )


def page(studies: Sequence[WorkPrecision], terms: Sequence[dict[str, Any]] = ()) -> str:
    """Write studies, and the rows of `cost_table` of their scenes, as one Markdown page."""
    found, rows = summary(studies), []
    for each in studies:
        own = found[found.scene == each.scene].set_index("target")
        cells = {
            f"{t:.0e} rad": f"{own.setting[t]}: {_time(own.wall_s[t])}" if t in own.index else None
            for t in TARGETS
        }
        run = "at rest" if each.rests else f"{each.seconds:g} s"
        rows.append({"scene": each.scene, "run": run, **cells})
    lines = [INTRODUCTION, "## Which method and step", "",
             "![time of the fastest setting, by scene](accuracy.png)", "",
             markdown(table(rows))]  # fmt: skip
    if terms:
        shown = [{**row, "ns": f"{row['ns']:.0f}"} for row in terms]
        lines += ["", "## What the terms of a scene cost", "", TERMS_INTRODUCTION,
                  markdown(table(shown))]  # fmt: skip
    for each in studies:
        lines += ["", f"## {each.scene}", "", f"**{fastest(each)}**", ""]
        if not each.rests:
            picture = f"accuracy_{each.scene}.png"
            lines += [f"![error against wall time, {each.scene}]({picture})", ""]
        if each.ends:
            lines.append(f"- Compared over {each.seconds:g} s; the run ends there: {each.ends}.")
        lines += [f"- {fact}" for fact in facts(each)]
        failed = int((each.rows.failure != "").sum())
        if failed:
            lines.append(f"- {failed} of {len(each.rows)} settings failed; they are in the CSV "
                         "and in the figure.")  # fmt: skip
        lines += [f"- Warning: {warning}." for warning in each.warnings]
        lines.append(f"- {provenance(compiled=each.compiled)}")
    return "\n".join(lines) + "\n"
