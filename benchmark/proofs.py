# SPDX-License-Identifier: Apache-2.0
"""What is proven of the shipped scenes and of the extreme cases, with processor times.

python -m benchmark.proofs [--scenes] [--catalogue] [--no-page]

Both by default. The table of docs/methods/proof.md and the column "proven" of
docs/stability.md are filled; every bound there is rounded outward.
"""

from __future__ import annotations

import sys
import time

from benchmark.measure import (
    DOCS,
    describe_machine,
    fill_page,
    join_line,
    read_options,
)
from sst_ros import certify, load_scene
from sst_ros.proof.balls import write_down, write_up
from sst_ros.report.results import data_frame, markdown
from sst_ros.scene.scene import names
from studies.extreme import prove_case
from studies.extreme_cases import catalogue

PROVEN_COLUMN = "proven"  # of the tables of docs/stability.md


def prove_scene(name: str) -> dict[str, str]:
    """Prove a shipped scene for its whole duration: a row of the table."""
    begin = time.process_time()
    proven = certify(load_scene(name))
    spent = time.process_time() - begin
    until = f"{write_down(proven.until, 15)} s"
    if proven.reason:
        until = f"{until}: {proven.reason}"
    return {
        "scene": name,
        "proven to": until,
        "whole": "yes" if proven.success else "**no**",
        "orientation within": f"{write_up(proven.largest)} rad",
        "error of `simulate` not above": f"{write_up(proven.error)} rad",
        "its estimate": f"{proven.trajectory.error_estimate:.2g} rad",
        "steps": str(proven.steps),
        "time": f"{spent:.2g} s" if spent < 10.0 else f"{spent:.0f} s",
    }


def prove_catalogue() -> dict[str, str]:
    """Prove the extreme cases: what the column says, by the name of the case."""
    cells = {}
    for case in catalogue():
        begin = time.process_time()
        cells[case.name] = prove_case(case)
        spent = time.process_time() - begin
        print(f"{case.name}: {cells[case.name]} ({spent:.1f} s)", flush=True)
    return cells


def summarize(cells: dict[str, str]) -> str:
    """Say how many cases are proven whole, or to where the motion ends."""
    whole = sum("rad to" not in cell and cell[0] != "-" for cell in cells.values())
    partly = sum("rad to" in cell for cell in cells.values())
    return (
        f"{whole} of {len(cells)} cases are proven whole, {partly} to an instant"
        f" before their end; nothing is proven of {len(cells) - whole - partly}."
    )


def fill_column(text: str, cells: dict[str, str]) -> str:
    """Return the page of the extreme cases with another column of proofs."""
    lines = []
    place = 0
    for line in text.splitlines():
        row = line.split(" | ")
        if row[0] == "| case":
            place = row.index(PROVEN_COLUMN)
        name = row[0].removeprefix("| ")
        if place and name in cells:
            row[place] = cells[name]
        lines.append(" | ".join(row))
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Prove and print; fill the pages."""
    options = read_options(
        "proofs", __doc__, arguments, scenes=False, catalogue=False, no_page=False
    )
    is_every = options.scenes == options.catalogue
    if options.scenes or is_every:
        rows = []
        for name in names():
            rows.append(prove_scene(name))
            print(rows[-1], flush=True)
        parts = {
            "proven scenes": markdown(data_frame(rows)),
            "proof run": f"{join_line(describe_machine('numpy', 'python-flint'))}.",
        }
        if not options.no_page:
            fill_page(DOCS / "methods" / "proof.md", parts)
    if options.catalogue or is_every:
        cells = prove_catalogue()
        print(summarize(cells))
        page = DOCS / "stability.md"
        if not options.no_page:
            filled = fill_column(page.read_text(encoding="utf-8"), cells)
            page.write_text(filled, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
