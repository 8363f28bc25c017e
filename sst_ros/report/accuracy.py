# SPDX-License-Identifier: Apache-2.0
"""The accuracy report: work-precision studies on the terminal, in files, and as one page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from sst_ros.host.compiled_module import numba_version
from sst_ros.plot.style import INK, MARKERS, Looks, legend, note, styled
from sst_ros.report import work_precision as study_of
from sst_ros.report.reference_solution import EXTENDED
from sst_ros.report.results import data_frame, markdown, provenance, publish, records, render
from sst_ros.report.scene_summary import cost_table
from sst_ros.report.work_precision import ERROR, WorkPrecision
from sst_ros.scene import scene

if TYPE_CHECKING:
    from pandas import DataFrame, Series

TARGET, TARGETS = 1e-9, (1e-3, 1e-6, 1e-9, 1e-12)
"""Orientation errors for which the fastest setting is named [rad]; TARGET is in titles."""


def write_accuracy_report(
    names: Sequence[str], out: Path, *, kind: str = EXTENDED
) -> list[WorkPrecision]:
    """Study scenes one after another; print each, and write all finished results into `out`.

    Files: accuracy.csv, .json, .md, .png, and accuracy_SCENE.png.

    Raises:
        SstError: a scene is refused or cannot start, or `out` cannot be written.

    """
    studies: list[WorkPrecision] = []
    terms: list[dict[str, Any]] = []
    for each in [scene.load(name) for name in names]:
        study = study_of.work_precision(each, kind=kind, shown=True)
        studies.append(study)
        terms += cost_table(each)
        print(accuracy_text(study), flush=True)
        figures = {} if study.rests else {f"accuracy_{each.name}": draw_accuracy(study)}
        if len(studies) == len(names):
            figures["accuracy"] = draw_fastest(list_fastest(studies), provenance())
        whole = {"studies": [document(one) for one in studies], "terms": terms}
        given = {"csv": join_grids(studies), "page": accuracy_page(studies, terms)}
        publish(out, "accuracy", document=whole, figures=figures, **given)
    return studies


def join_grids(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return the grids of all studies as one table."""
    return data_frame(row for study in studies for row in records(study.rows))


def document(study: WorkPrecision) -> dict[str, Any]:
    """Return a study as JSON has it."""
    return {
        "scene": study.scene,
        "seconds": study.seconds,
        "ends": study.ends,
        "compiled": numba_version() is not None,
        "reference": study.reference.how,
        "reference_own_error": study.reference.own._asdict(),
        "formulation_difference_relative": study.formulation,
        "advice": study.advice._asdict(),
        "advice_measured_error_rad": study.measured and study.measured[0],
        "fastest": fastest(study),
        "warnings": list(study.warnings),
        "rows": records(study.rows),
    }


def list_fastest(studies: Sequence[WorkPrecision]) -> DataFrame:
    """Return method and time, as a share of the motion's, of the fastest setting by target."""
    rows = [
        {"scene": study.scene, "target": target, "method": best.method}
        | {"share": best.wall_min_s / study.seconds}
        for study in studies
        for target, best in _choose(study).items()
    ]
    return data_frame(rows, ("scene", "target", "method", "share"))


def _choose(study: WorkPrecision) -> dict[float, Series[Any]]:
    """Return the fastest setting for each of TARGETS that has one and is not below the floor."""
    found = {target: study.best(target) for target in TARGETS if target >= study.floor}
    return {target: row for target, row in found.items() if row is not None}


def fastest(study: WorkPrecision) -> str:
    """Return the fastest setting for TARGET as a sentence."""
    best = study.best(TARGET)
    if study.rests:
        return "It rests: it has no torques of its own, a controller drives it along its motion."
    if best is not None:
        return f"{TARGET:.0e} rad over {study.seconds:g} s: {setting(best)}, {_time(best)}."
    least = study.rows[ERROR].astype(float).min()
    reached = f"the least error is {least:.0e} rad" if least >= 0.0 else "every one failed"
    return f"No setting that was tried reaches {TARGET:.0e} rad with every finer one; {reached}."


def setting(row: Series[Any]) -> str:
    """Return method and setting in words."""
    if row.kind == study_of.TOLERANCE:
        return f"{row.method}, tolerance {row.setting:.0e}"
    return f"{row.method}, {1e3 * row.setting:.4g} ms steps"


def _time(row: Series[Any]) -> str:
    wall_ms = 1e3 * row.wall_min_s
    return f"{wall_ms:.2g} ms" if wall_ms < 99.5 else f"{wall_ms:.0f} ms"


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


def accuracy_text(study: WorkPrecision) -> str:
    """Format a study for the terminal."""
    shown = study.rows.assign(setting=[setting(row) for _, row in study.rows.iterrows()])
    shown = shown[["setting", "evaluations", *HEADS]].rename(columns=HEADS)
    below = [row is True for row in study.rows.below_floor]
    shown[""] = ["*" if row else "" for row in below]
    shown["failure"] = [f"FAILED: {why[:60]}" if why else "" for why in study.rows.failure]
    grid = shown.to_string(index=False, na_rep="-", float_format=lambda x: f"{x:.1e}")
    return render(
        "accuracy.txt", study=study, grid=grid, below=sum(below),
        fastest=fastest(study), provenance=provenance(),
    )  # fmt: skip


def accuracy_page(studies: Sequence[WorkPrecision], terms: Sequence[dict[str, Any]] = ()) -> str:
    """Write studies, and the rows of `cost_table` of their scenes, as one Markdown page."""
    rows = []
    for each in studies:
        run = "at rest" if each.rests else f"{each.seconds:g} s"
        cells: dict[str, Any] = {f"{target:.0e} rad": None for target in TARGETS}
        cells |= {f"{t:.0e} rad": f"{setting(x)}: {_time(x)}" for t, x in _choose(each).items()}
        rows.append({"scene": each.scene, "run": run, **cells})
    costs = data_frame({**row, "ns": f"{row['ns']:.0f}"} for row in terms)
    return render(
        "accuracy.md",
        studies=studies,
        summary=markdown(data_frame(rows)),
        terms=markdown(costs) if terms else "",
        fastest=fastest,
        provenance=provenance(),
    )


@styled
def draw_accuracy(study: WorkPrecision) -> Figure:
    """Draw the largest errors of orientation and actuator rates over wall time, side by side.

    The fastest setting for each of TARGETS is marked.
    """
    rows, floor = study.rows, study.floor
    figure = Figure(figsize=(11.0, 6.4))
    body: Any = figure.subfigures()
    panels = body.subplots(1, 2, sharex=True)
    rate = study_of.ABOVE_REFERENCE * study.reference.own.gamma_dot
    for axes, quantity, least, label in (
        (panels[0], ERROR, floor, "largest error of the orientation [rad]"),
        (panels[1], "largest_gamma_dot_rad_per_s", rate, "largest error of γ̇ [rad/s]"),
    ):
        _draw_grid(axes, rows, quantity, least)
        axes.set(xlabel=f"wall time for {study.seconds:g} s of motion [ms]", ylabel=label)
    best = _choose(study)
    for target, row in best.items():
        panels[0].axhline(target, color=INK, linewidth=0.9, linestyle=":")
        panels[0].plot(1e3 * row.wall_min_s, max(row[ERROR], floor), "o", color=INK, **_RING)
    used = {name: look for name, look in MARKERS.items() if name in set(rows.method)}
    handles = [_entry(name, mark, colour, linewidth=1.5) for name, (colour, mark) in used.items()]
    handles.append(_entry("fixed steps (full)", "o"))
    handles.append(_entry("tolerance (hollow)", "o", markerfacecolor="white", linestyle="--"))
    if (rows.failure != "").any():
        handles.append(_entry("failed", "x", linestyle="none"))
    if best:
        name = f"fastest for {', '.join(f'{target:.0e}' for target in best)} rad"
        handles.append(_entry(name, "o", **_RING, linestyle=":"))
    body.legend(handles=handles, fontsize=8, frameon=False, loc="outside lower center", ncol=9)
    figure.suptitle(f"{study.scene}: error against wall time\n{fastest(study)}", fontsize=12)
    note(figure, f"Reference: {study.reference.how}. {provenance()}", 185)
    return figure


_RING: Looks = {"markersize": 14, "markerfacecolor": "none", "markeredgewidth": 1.4, "zorder": 5}


def _entry(label: str, marker: str, color: str = INK, **looks: Any) -> Line2D:
    """Return an entry of a legend."""
    return Line2D([], [], label=label, marker=marker, color=color, **looks)


def _draw_grid(axes: Axes, rows: DataFrame, quantity: str, floor: float) -> None:
    axes.set(xscale="log", yscale="log")
    drawn = rows[(rows[quantity] >= floor) & (rows[quantity] > 0.0) & (rows.wall_min_s > 0.0)]
    for (name, kind), group in drawn.groupby(["method", "kind"], sort=False):
        colour, marker = MARKERS[name]
        face, line = (colour, "-") if kind == study_of.FIXED else ("white", "--")
        looks: Looks = {"marker": marker, "linestyle": line, "markerfacecolor": face, "zorder": 3}
        x, y = 1e3 * group.wall_min_s, group[quantity]
        axes.plot(x, y, color=colour, markersize=6.5, linewidth=1.5, **looks)
    errors: Any = drawn[quantity]
    high = 10.0 ** math.ceil(math.log10(errors.max() if len(errors) else 1.0) + 0.01)
    low = 10.0 ** math.floor(math.log10(errors.min() if len(errors) else high * 1e-3) - 0.7)
    top = high * (high / low) ** 0.1
    across: Looks = {"transform": axes.get_yaxis_transform(), "va": "center"}
    failed = rows[rows.failure != ""]
    if len(failed):  # in a band above everything, at their wall time
        axes.axhspan(high, top, color="#f4e3d7", linewidth=0)
        middle = math.sqrt(high * top)
        axes.text(0.99, middle, f"failed: {len(failed)}", ha="right", fontsize=8.5, **across)
        for name, wall in zip(failed.method, 1e3 * failed.wall_min_s, strict=True):
            colour, marker = MARKERS[name]
            x = wall if wall > 0.0 else np.nan
            axes.plot(x, middle, marker, color=colour, markerfacecolor="none", zorder=3)
            axes.plot(x, middle, "x", color=INK, markersize=5, zorder=4)
    if floor > low:
        axes.axhspan(low, floor, color="#999999", alpha=0.25, linewidth=0)
        text = "100 × the reference's own error: none plotted"
        axes.text(0.02, math.sqrt(low * floor), text, fontsize=7.5, **across)
    axes.set_ylim(low, top)
    axes.yaxis.set_major_locator(LogLocator(numticks=12))
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def draw_fastest(rows: DataFrame, said: str) -> Figure:
    """Draw rows of `list_fastest`, a line of markers for each scene, and a footnote."""
    names = list(dict.fromkeys(rows.scene))
    figure = Figure(figsize=(9.0, 1.7 + 0.36 * len(names)))
    axes = figure.subplots()
    sizes = {t: 5.5 + 3.0 * k for k, t in enumerate(sorted(set(rows.target), reverse=True))}
    hollow: Looks = {"markerfacecolor": "none", "linestyle": "none"}
    for row in rows.itertuples():
        colour, marker = MARKERS[row.method]
        place = 100.0 * row.share, names.index(row.scene)
        looks: Looks = {"color": colour, "markersize": sizes[row.target], "markeredgewidth": 1.5}
        axes.plot(*place, marker, **looks, **hollow)
    axes.axvline(100.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set(xscale="log", xlabel="wall time of the integration per time of the motion [%]")
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    figure.suptitle(
        "Fastest setting for an error of the orientation", fontsize=11, x=0.02, ha="left"
    )
    used = {name: look for name, look in MARKERS.items() if name in set(rows.method)}
    handles = [_entry(name, mark, colour, **hollow) for name, (colour, mark) in used.items()]
    for target, size in sizes.items():
        handles.append(_entry(f"{target:.0e} rad", "o", markersize=size, **hollow))
    legend(axes, handles=handles, ncol=5)
    note(figure, said, 150)
    return figure
