# SPDX-License-Identifier: Apache-2.0
"""The report of accuracy: studies of scenes on the terminal, in files, and as one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sst_ros import scene
from sst_ros.output_folder import writing
from sst_ros.studies.accuracy import Study, study
from sst_ros.studies.accuracy_table import (
    advice,
    as_csv,
    as_json,
    made,
    milliseconds,
    setting,
    text,
)
from sst_ros.studies.high_precision import EXTENDED

TARGETS = (1e-6, 1e-9, 1e-12)

INTRODUCTION = """\
# Accuracy and what it costs

Written by `python -m sst_ros report accuracy`; all figures are from the machine and the date below
the tables.

Every method solves the scene under its own torques, as continuous functions of time, and is
compared with a reference at twenty or more instants: DOP853 with fixed steps in extended precision.
The reference's own error is twice what two step sizes differ by; an error is plotted only if it is
100 times larger than that. Times are of the integration alone, the shortest of several runs,
without compilation. Fixed steps look at no error estimate. Tolerances include the companion that
`Simulation` keeps for its estimate of the global error, three steps for each, and one loop in
Python around them. Where ends are elastic, force has kinks: fixed steps step over them, and
tolerances are given to `Simulation`, which stops at each; it is the reference there too. Errors are
the largest over the run.
"""


def report(
    names: Sequence[str], out: Path, *, kind: str = EXTENDED, compiled: bool = True
) -> list[Study]:
    """Study scenes one after another; print each, and write what is known so far into `out`.

    Files: accuracy.csv, accuracy.json, accuracy.md, accuracy_SCENE.png.

    Raises:
        SstError: a scene is refused or cannot start, or `out` cannot be written.

    """
    from sst_ros.plot.accuracy import draw

    scenes = [scene.load(name) for name in names]
    studies: list[Study] = []
    for each in scenes:
        studies.append(study(each, kind=kind, compiled=compiled, shown=True))
        print(text(studies[-1]), flush=True)
        with writing(out, "report"):
            draw(studies[-1], out / f"accuracy_{each.name}.png")
            (out / "accuracy.csv").write_text(as_csv(studies), encoding="utf-8")
            (out / "accuracy.json").write_text(as_json(studies), encoding="utf-8")
            (out / "accuracy.md").write_text(page(studies), encoding="utf-8")
    return studies


def page(studies: Sequence[Study]) -> str:
    """Write studies as one Markdown page."""
    lines = [INTRODUCTION, "## Which method and step", ""]
    lines.append("| scene | run | " + " | ".join(f"{t:.0e} rad" for t in TARGETS) + " |")
    lines.append("| --- | --- |" + " --- |" * len(TARGETS))
    for each in studies:
        cells = []
        for target in TARGETS:
            best = each.best(target) if target >= each.floor else None
            cells.append(
                f"{best.method}, {setting(best)}: {milliseconds(best.wall_s[0])}" if best else "-"
            )
        lines.append(f"| {each.scene} | {each.seconds:g} s | " + " | ".join(cells) + " |")
    for each in studies:
        own = each.reference.own
        lines += ["", f"## {each.scene}", "", f"**{advice(each)}**", ""]
        lines.append(f"![error over wall time, {each.scene}](accuracy_{each.scene}.png)")
        lines.append("")
        if each.ends:
            lines.append(f"- Compared over {each.seconds:g} s; the run ends there: {each.ends}.")
        lines.append(
            f"- Reference: {each.reference.how}. Its own error: {own.orientation:.1e} rad, gamma "
            f"{own.gamma:.1e} rad, gamma_dot {own.gamma_dot:.1e} rad/s."
        )
        if each.formulation is not None:
            lines.append(
                f"- Kernel against the paper's equations, along the reference: "
                f"{each.formulation:.1e} of the largest acceleration."
            )
        failed = sum(bool(row.failure) for row in each.rows)
        if failed:
            lines.append(f"- {failed} of {len(each.rows)} ways failed; they are in the CSV and "
                         "in the picture.")  # fmt: skip
        lines += [f"- Warning: {warning}." for warning in each.warnings]
        lines.append(f"- {made(each)}")
    return "\n".join(lines) + "\n"
