# SPDX-License-Identifier: Apache-2.0
"""The fenced blocks, links and inline commands of a page of Markdown."""

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
GENERATED = (
    "accuracy.md", "control_rate.md", "estimate.md", "feedforward.md", "peers.md",
    "realtime.md", "stability.md",
)  # fmt: skip
"""Reports, whose words are not instructions."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its page, first line, language, text."""

    page: str
    line: int
    language: str
    text: str

    def __str__(self):
        return f"{self.page}:{self.line}"


def pages():
    """README and all pages of the site, relative to the source tree."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [str(path.relative_to(ROOT)) for path in found if path.name not in GENERATED]


def blocks(page):
    result, text = [], (ROOT / page).read_text(encoding="utf-8")
    pattern = r"^(?P<fence>```+)(?P<info>[^\n]*)\n(?P<text>.*?)^(?P=fence)[ \t]*$"
    for found in re.finditer(pattern, text, re.S | re.M):
        line = text[: found.start()].count("\n") + 2
        language = (found["info"].split() or [""])[0]
        result.append(Block(page, line, language, found["text"]))
    return result


def prose(page):
    """The page without its fenced blocks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.sub(r"^(```+).*?^\1[ \t]*$", "", text, flags=re.S | re.M)


def commands(text):
    """Lines of a shell block: continued ones joined, no comments and no empty ones."""
    joined = re.sub(r"\s*\\\n\s*", " ", text)
    bare = (
        re.sub(r"(^|\s)#(?!!).*$", "", line).strip() for line in joined.splitlines()
    )
    return [line for line in bare if line]


def links(page):
    """Targets of links and pictures within the tree."""
    found = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [target for target in found if not re.match(r"[a-z]+:", target)]
