# SPDX-License-Identifier: Apache-2.0
"""Write version and metadata of package.xml into the other files that need them.

    python -m tools.metadata           # write
    python -m tools.metadata --filled  # fail while a marked element is not filled in
    python -m tools.metadata --next    # print the next minor version

setup.py reads package.xml itself.
"""

from __future__ import annotations

import argparse
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHARED = ("version", "maintainer", "license", "url", "author")
"""Elements of package.xml that are also those of hardware/package.xml."""

PLACEHOLDER = ".invalid"
"""End of addresses that exist nowhere (RFC 2606)."""

VERSIONS = {
    "sst_ros/version.py": r'^VERSION = "(.*)"$',
    "CITATION.cff": r"^version: (.*)$",
    "pixi.toml": r'^version = "(.*)"$',
    "conda/recipe.yaml": r'^  version: "(.*)"$',
}
"""Pattern of the line that has the version."""


def package() -> str:
    """Read package.xml."""
    return (ROOT / "package.xml").read_text(encoding="utf-8")


def version() -> str:
    """Return the version of package.xml."""
    return str(ET.fromstring(package()).findtext("version"))


def next_version() -> str:
    """Return the minor version that follows that of package.xml."""
    major, minor, _ = map(int, version().split("."))
    return f"{major}.{minor + 1}.0"


def with_version(text: str, pattern: str) -> str:
    """Put the version of package.xml into the one line of a text that has it."""
    line = re.search(pattern, text, re.M)
    if line is None:
        raise ValueError(f"no line matches {pattern}")
    return text[: line.start(1)] + version() + text[line.end(1) :]


def hardware_package(text: str) -> str:
    """Put the shared elements of package.xml into the text of hardware/package.xml."""
    lines = {name: re.findall(rf"^  <{name}\b.*\n", package(), re.M) for name in SHARED}
    for name in SHARED:
        text = re.sub(rf"^  <{name}\b.*\n", "", text, flags=re.M)
    above, description, below = re.split(
        r"^(  <description>.*\n)", text, maxsplit=1, flags=re.M
    )
    after = "".join(line for name in SHARED[1:] for line in lines[name])
    return above + "".join(lines["version"]) + description + after + below


def written() -> dict[str, str]:
    """Return the text that each file must have, by its path."""
    texts = {}
    for name, pattern in VERSIONS.items():
        texts[name] = with_version((ROOT / name).read_text(encoding="utf-8"), pattern)
    path = "hardware/package.xml"
    texts[path] = hardware_package((ROOT / path).read_text(encoding="utf-8"))
    return texts


def placeholders() -> list[str]:
    """List the elements of package.xml that a person must still fill in."""
    texts = [
        ET.tostring(element, "unicode").strip() for element in ET.fromstring(package())
    ]
    return [text for text in texts if PLACEHOLDER in text]


def main() -> int:
    """Write the files, or tell what the options ask for; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.metadata", description=__doc__
    )
    parser.add_argument(
        "--filled", action="store_true", help="fail where package.xml has marks"
    )
    parser.add_argument(
        "--next", action="store_true", help="print the next minor version"
    )
    options = parser.parse_args()
    if options.next:
        print(next_version())
        return 0
    if options.filled:
        for line in placeholders():
            print(f"package.xml: {line}: must be filled in", file=sys.stderr)
        return 1 if placeholders() else 0
    for name, text in written().items():
        (ROOT / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
