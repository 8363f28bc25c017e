# SPDX-License-Identifier: Apache-2.0
"""The accuracy report: work-precision studies on the terminal, in files, and as one page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.plot.methods import draw_summary, draw_work_precision
from sst_ros.report.reference_solution import EXTENDED
from sst_ros.report.results import data_frame, markdown, provenance, records, render, write
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


def write_accuracy_report(
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
        study = work_precision(each, kind=kind, compiled=compiled, shown=True)
        studies.append(study)
        terms += cost_table(each, compiled=compiled)
        print(text(study), flush=True)
        figures = {} if study.rests else {f"accuracy_{each.name}": figure(study)}
        if len(studies) == len(names):
            figures["accuracy"] = draw_summary(summary(studies), provenance(compiled=compiled))
        document = {"studies": [*documents(studies)], "terms": terms}
        whole, said = join_grids(studies), page(studies, terms)
        write(out, "accuracy", csv=whole, document=document, page=said, figures=figures)
    return studies


def join_grids(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return the grids of all studies as one table."""
    return data_frame(row for study in studies for row in records(study.rows))


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
    found = [
        (study, target, best)
        for study in studies
        for target in TARGETS
        if (best := study.best(target) if target >= study.floor else None) is not None
    ]
    rows = [
        {
            "scene": study.scene,
            "target": target,
            "method": best.method,
            "setting": setting(best),
            "wall_s": best.wall_min_s,
            "share": best.wall_min_s / study.seconds,
        }
        for study, target, best in found
    ]
    return data_frame(rows, ("scene", "target", "method", "setting", "wall_s", "share"))


def fastest(study: WorkPrecision, target: float = TARGET) -> str:
    """Return the fastest setting for a target as a sentence."""
    best = study.best(target)
    if study.rests:
        return "It rests: it has no torques of its own, a controller drives it along its motion."
    if best is None:
        least = study.rows[ERROR].astype(float).min()
        reached = f"the least error is {least:.0e} rad" if least >= 0.0 else "every one failed"
        tried = f"No setting that was tried reaches {target:.0e} rad with every finer one"
        return f"{tried}; {reached}."
    return f"{target:.0e} rad over {study.seconds:g} s: {setting(best)}, {_time(best.wall_min_s)}."


def setting(row: Series[Any]) -> str:
    """Return method and setting in words."""
    if row.kind == TOLERANCE:
        return f"{row.method}, tolerance {row.setting:.0e}"
    return f"{row.method}, {1e3 * row.setting:.4g} ms steps"


def _time(wall_s: float) -> str:
    return f"{1e3 * wall_s:.2g} ms" if wall_s < 0.0995 else f"{1e3 * wall_s:.0f} ms"


HEADS = {
    "wall_min_s": "min [s]",
    "wall_median_s": "median [s]",
    "final_orientation_rad": "end [rad]",
    ERROR: "largest [rad]",
    "largest_gamma_rad": "gamma [rad]",
    "largest_gamma_dot_rad_per_s": "rate [rad/s]",
    "energy_residual_J": "energy [J]",
    "closure_residual": "closure",
}
"""Columns of the grid that the terminal shows, and their heads there."""


def text(study: WorkPrecision) -> str:
    """Format a study for the terminal."""
    shown = study.rows.assign(setting=[setting(row) for _, row in study.rows.iterrows()])
    shown = shown[["setting", "evaluations", *HEADS]].rename(columns=HEADS)
    below = [row is True for row in study.rows.below_floor]
    shown[""] = ["*" if row else "" for row in below]
    shown["failure"] = [f"FAILED: {why[:60]}" if why else "" for why in study.rows.failure]
    return render(
        "accuracy.txt",
        study=study,
        facts=facts(study),
        grid=shown.to_string(index=False, na_rep="-", float_format=lambda x: f"{x:.1e}"),
        below=sum(below),
        fastest=fastest(study),
        provenance=provenance(compiled=study.compiled),
    )


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
    found = {target: study.best(target) for target in TARGETS if target >= study.floor}
    return draw_work_precision(
        study.rows,
        floors=(study.floor, ABOVE_REFERENCE * study.reference.own.gamma_dot),
        seconds=study.seconds,
        best={
            target: (1e3 * row.wall_min_s, max(row[ERROR], study.floor))
            for target, row in found.items()
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
    costs = data_frame({**row, "ns": f"{row['ns']:.0f}"} for row in terms)
    return render(
        "accuracy.md",
        studies=studies,
        summary=markdown(data_frame(rows)),
        terms=markdown(costs) if terms else "",
        fastest=fastest,
        facts=facts,
        provenance=provenance,
    )
