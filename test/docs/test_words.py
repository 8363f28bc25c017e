# SPDX-License-Identifier: Apache-2.0
"""Texts use terms of the field: words that a reader would have to decode stay out."""

import re

import pytest
from docs.blocks import ROOT

PATTERN = re.compile(
    r"\b(told|(?<!\.)tells?|judged?|judges|journey|promptest|sooner|ways?|"
    r"nobody|anybody|whoever|watched|"
    r"so far|in no time|to and fr[o]|hangs? on|gets? there|lets? go of|laid out|lays?"
    r" out|for ever|"
    r"the house|what (?:has come|they have wrong|became|came))\b|"
    r"\bcompanion\b(?! (?:matrix|=|\[))",
    re.IGNORECASE,
)
ALLOWED = {
    "sst_ros/mechanism/kinematics.py": "companion",  # of a polynomial: the field's term
    "docs/paper.md": "companion",
}
TREES = (("sst_ros", "*.py"), ("docs", "*.md"), ("docs", "*.ipynb"), ("launch", "*.py"),
         ("examples", "*.*"), ("config", "*.*"))  # fmt: skip
FILES = sorted(
    str(path.relative_to(ROOT))
    for path in (
        *(path for folder, kind in TREES for path in (ROOT / folder).rglob(kind)),
        *ROOT.glob("*.md"),
    )
    if path.name != "CHANGELOG.md" and "gallery" not in path.parts
)


@pytest.mark.parametrize("name", FILES)
def test_a_text_is_in_plain_terms(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    if name.endswith(".ipynb"):
        text = re.sub(r'"image/png": ".*"|base64,[^"]*', "", text)
    found = {match.group().lower() for match in PATTERN.finditer(text)}
    assert found - {ALLOWED.get(name, "")} == set()
