# SPDX-License-Identifier: Apache-2.0
"""Write the places in the code into docs/paper.md: `python -m tools.paper_page`.

They are read from the equation numbers in comments and docstrings of
`sst_ros/mechanism`, so a renamed function changes the page and a missing number stops
it. A row of the table:

    | 4 | $w_k^T s > 0$ | As printed. | `kinematics.direct` |
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "paper.md"
TAG = re.compile(r"Eqs?\. ((?:\d+(?: to \d+)?(?:, | and )?)+)")
ROW = re.compile(r"^(\| (\d+) \| \$.*\$ \| .* \| )`[\w.]+` \|$", re.MULTILINE)


def numbers(text: str) -> Iterator[tuple[int, int]]:
    """Yield each equation number in a text, and the length of the range it is in."""
    for tag in TAG.finditer(text):
        for first, last in re.findall(r"(\d+)(?: to (\d+))?", tag[1]):
            span = range(int(first), int(last or first) + 1)
            yield from ((number, len(span)) for number in span)


def places() -> dict[int, str]:
    """Return for each equation the function that names it most narrowly.

    Comments and docstrings are read.
    """
    lines: dict[int, tuple[int, str]] = {}
    for path in sorted((ROOT / "sst_ros" / "mechanism").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        owners = [
            node
            for node in tree.body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        ]
        for line, text in enumerate(source.splitlines(), 1):
            owner = next(
                (o for o in owners if o.lineno <= line <= (o.end_lineno or 0)), None
            )
            if owner is None:
                continue
            for number, width in numbers(text):
                # Among equal widths the paper's own file wins over the helpers around
                # it.
                rank = width if path.stem == "virtual_work" else 2 * width
                if number not in lines or rank < lines[number][0]:
                    lines[number] = rank, f"`{path.stem}.{owner.name}`"
    return {number: place for number, (_, place) in lines.items()}


def page(text: str) -> str:
    """Write the places into the rows of the table.

    Raises:
        SystemExit: an equation has no place in the code.

    """
    code = places()
    if missing := [row[1] for row in ROW.findall(text) if int(row[1]) not in code]:
        sys.exit(f"sst_ros/mechanism names no place for the equations {missing}")
    return ROW.sub(lambda row: f"{row[1]}{code[int(row[2])]} |", text)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
