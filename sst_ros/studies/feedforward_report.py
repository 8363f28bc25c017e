# SPDX-License-Identifier: Apache-2.0
"""The study of feedforward on the terminal, in files, and as one page."""

from __future__ import annotations

from pathlib import Path

from sst_ros.output_folder import writing
from sst_ros.studies.feedforward import Plan, Study, study
from sst_ros.studies.feedforward_table import as_csv, as_json, made, notes, rows, shown, text, title

INTRODUCTION = """\
# How good feedforward is

Written by `python -m sst_ros study feedforward`; all figures are from the machine and the date
below.

Every mode of control follows the motion of the scene against everything that a controller may have
wrong: bodies 20 % too heavy or too light in its model (masses and inertias together), friction or
gravity that its model has not, commands that act some samples late, encoders of so many steps a
turn (they measure no rate: it is the difference of the last two angles), and noise on angle (1e-4
rad) and rate (1e-2 rad/s). Plant and controller run in lockstep in one process. Errors are those of
the true state. A loop with feedback that swings by more than 2 % of the longest way of a joint, or
has a torque at its limit, long after the motion has ended does not come to rest: it has failed, as
one that leaves its stroke or its workspace. `sst_ros/studies/feedforward.py` and `sampled_data.py`
derive what is to be expected.
"""


def report(plan: Plan, out: Path, *, workers: int | None = None) -> Study:
    """Do a study; print it, and write feedforward.csv, .json, .md and .png into `out`.

    Raises:
        SstError: the scene has no motion or cannot start, or `out` cannot be written.

    """
    from sst_ros.plot.feedforward import draw

    found = study(plan, workers=workers, shown=True)
    print(text(found), flush=True)
    with writing(out, "study"):
        draw(found, out / "feedforward.png")
        (out / "feedforward.csv").write_text(as_csv(found), encoding="utf-8")
        (out / "feedforward.json").write_text(as_json(found), encoding="utf-8")
        (out / "feedforward.md").write_text(page(found), encoding="utf-8")
    return found


def page(found: Study) -> str:
    """Write a study as one Markdown page."""
    heads, *table = rows(found)
    lines = [INTRODUCTION, f"**{title(found)}.**", "", "![the study](feedforward.png)", ""]
    lines += ["## What holds", "", *(f"- {line.strip()}" for line in shown(found)), ""]
    lines += ["## RMS error of gamma [rad]", "", "| " + " | ".join(heads) + " |"]
    lines.append("| --- |" + " --- |" * (len(heads) - 1))
    lines += ["| " + " | ".join(row) + " |" for row in table]
    lines += ["", *(f"- {line}" for line in notes(found)), "", made(found), ""]
    return "\n".join(lines)
