# SPDX-License-Identifier: Apache-2.0
"""Write docs/paper.md: each equation of the paper, what holds, where it is in the code, its test.

`python -m tools.paper_page`. Places in the code are read from the equation numbers in comments and
docstrings of `sst_ros/mechanism`, so a renamed function changes the page and a missing number
stops it.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from tools.paper_equations import HOLDS, READ, WHOLE

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "paper.md"
TEMPLATE = ROOT / "tools" / "paper_page.md"
TEST = "test/mechanism/test_paper_equations.py"
TAG = re.compile(r"Eqs?\. ((?:\d+(?: to \d+)?(?:, | and )?)+)")


def numbers(text: str) -> Iterator[tuple[int, int]]:
    """Yield each equation number in a text with the length of the range it was named in."""
    for tag in TAG.finditer(text):
        for first, last in re.findall(r"(\d+)(?: to (\d+))?", tag[1]):
            span = range(int(first), int(last or first) + 1)
            yield from ((number, len(span)) for number in span)


def places() -> dict[int, str]:
    """Return for each equation the function whose comment or docstring names it most narrowly."""
    found: dict[int, tuple[int, str]] = {}
    for path in sorted((ROOT / "sst_ros" / "mechanism").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        owners = [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))]
        for line, text in enumerate(source.splitlines(), 1):
            owner = next((o for o in owners if o.lineno <= line <= (o.end_lineno or 0)), None)
            if owner is None:
                continue
            for number, width in numbers(text):
                place = f"`{path.stem}.{owner.name}`"
                best = found.get(number)
                # Among equal widths the paper's own file wins over the helpers around it.
                rank = width if path.stem == "virtual_work" else 2 * width
                if best is None or rank < best[0]:
                    found[number] = rank, place
    return {number: place for number, (_, place) in found.items()}


def status(number: int) -> str:
    """Say how the printed equation, as far as its text shows it, stands to the one that holds."""
    if number in READ:
        return READ[number]
    return "As printed." if number in WHOLE else "Signs restored."


def table() -> str:
    """Return the table of all equations.

    Raises:
        SystemExit: an equation has no place in the code.

    """
    code = places()
    missing = sorted(set(HOLDS) - set(code))
    if missing:
        sys.exit(f"sst_ros/mechanism names no place for the equations {missing}")
    rows = ["| Eq. | what holds | text of the paper | code |", "| --- | --- | --- | --- |"]
    for number, equation in HOLDS.items():
        rows.append(f"| {number} | ${equation}$ | {status(number)} | {code[number]} |")
    return "\n".join(rows)


def page() -> str:
    """Return the whole page."""
    return TEMPLATE.read_text(encoding="utf-8").replace("{{ equations }}", table())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
