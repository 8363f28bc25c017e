# SPDX-License-Identifier: Apache-2.0
"""Write CHANGELOG.rst from the released sections of CHANGELOG.md.

    python -m tools.changelog_rst
    python -m tools.changelog_rst --release 0.2.0  # date what is unreleased first

bloom reads CHANGELOG.rst (REP 132), and that of the package in hardware/.
"""

from __future__ import annotations

import argparse
import re
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]
_RELEASE = re.compile(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", re.M)


def text(markdown: str) -> str:
    """Convert the released sections of a changelog after Keep a Changelog.

    Others stay out.
    """
    title = "Changelog for package sst_ros"
    sections = [f"{'^' * len(title)}\n{title}\n{'^' * len(title)}\n"]
    releases = _RELEASE.split(markdown)
    for version, day, body in zip(
        releases[1::3], releases[2::3], releases[3::3], strict=True
    ):
        head = f"{version} ({day})"
        body = re.split(r"^(?:## |\[)", body, maxsplit=1, flags=re.M)[0].strip()
        sections.append(f"{head}\n{'-' * len(head)}\n\n{_body(body)}\n")
    return "\n".join(sections)


def _body(markdown: str) -> str:
    """Headings become bold paragraphs: catkin_pkg leaves nested sections out."""
    rst = re.sub(r"^### (.*)$", r"**\1**", markdown, flags=re.M)
    rst = re.sub(r"\[([^\]]+)\]\((http[^)]+)\)", r"`\1 <\2>`__", rst)
    return re.sub(
        r"(?<!`)`([^`<]+)`(?!_)", lambda code: f"``{' '.join(code[1].split())}``", rst
    )


def date_markdown(markdown: str, version: str, day: date) -> str:
    """Give what is unreleased a version and a date; an empty section stays above.

    Raises:
        ValueError: the version has a section, or nothing is unreleased.

    """
    head = "## [Unreleased]\n"
    if f"## [{version}]" in markdown or head not in markdown:
        raise ValueError(
            f"CHANGELOG.md: must have a section Unreleased and none of {version}"
        )
    return markdown.replace(head, f"{head}\n## [{version}] - {day}\n", 1)


def date_hardware(rst: str, version: str, day: date) -> str:
    """Give the section Forthcoming a version and a date.

    Where there is no such section, the version has one without changes.
    """
    head = f"{version} ({day})"
    heading = f"{head}\n{'-' * len(head)}\n"
    forthcoming = re.search(r"^Forthcoming\n-+\n", rst, re.M)
    if forthcoming is not None:
        return rst.replace(forthcoming[0], heading, 1)
    title, above, below = rst.partition("^\n\n")
    return f"{title}{above}{heading}\n* No changes.\n\n{below}"


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.changelog_rst", description=__doc__
    )
    parser.add_argument("--release", metavar="VERSION", help="date what is unreleased")
    version = parser.parse_args().release
    path = ROOT / "CHANGELOG.md"
    markdown = path.read_text(encoding="utf-8")
    if version is not None:
        markdown = date_markdown(markdown, version, date.today())
        path.write_text(markdown, encoding="utf-8")
        hardware = ROOT / "hardware/CHANGELOG.rst"
        dated = date_hardware(
            hardware.read_text(encoding="utf-8"), version, date.today()
        )
        hardware.write_text(dated, encoding="utf-8")
    (ROOT / "CHANGELOG.rst").write_text(text(markdown), encoding="utf-8")


if __name__ == "__main__":
    main()
