# SPDX-License-Identifier: Apache-2.0
"""Write CHANGELOG.rst from the released sections of CHANGELOG.md.

bloom reads CHANGELOG.rst (REP 132).

python -m tools.changelog_rst
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
_RELEASE = re.compile(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", re.M)


def text(markdown: str) -> str:
    """Convert the released sections of a changelog after Keep a Changelog.

    Others stay out.
    """
    title = "Changelog for package sst_ros"
    parts = [f"{'^' * len(title)}\n{title}\n{'^' * len(title)}\n"]
    found = _RELEASE.split(markdown)
    for version, date, body in zip(found[1::3], found[2::3], found[3::3], strict=True):
        head = f"{version} ({date})"
        body = re.split(r"^(?:## |\[)", body, maxsplit=1, flags=re.M)[0].strip()
        parts.append(f"{head}\n{'-' * len(head)}\n\n{_body(body)}\n")
    return "\n".join(parts)


def _body(markdown: str) -> str:
    """Headings become bold paragraphs: catkin_pkg leaves nested sections out."""
    out = re.sub(r"^### (.*)$", r"**\1**", markdown, flags=re.M)
    out = re.sub(r"\[([^\]]+)\]\((http[^)]+)\)", r"`\1 <\2>`__", out)
    return re.sub(
        r"(?<!`)`([^`<]+)`(?!_)", lambda code: f"``{' '.join(code[1].split())}``", out
    )


def main() -> None:
    """Write the file."""
    markdown = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (ROOT / "CHANGELOG.rst").write_text(text(markdown), encoding="utf-8")


if __name__ == "__main__":
    main()
