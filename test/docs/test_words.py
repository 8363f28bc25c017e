# SPDX-License-Identifier: Apache-2.0
"""Texts use the terms of the field: words that a reader would have to decode stay out."""

import re

import pytest
from docs.blocks import ROOT

PATTERN = re.compile(
    r"\b(told|tells|judged?|judges|journey|promptest|what has come|what they have wrong)\b|"
    r"\bcompanion\b(?! (?:matrix|=|\[))",
    re.IGNORECASE,
)
ALLOWED = {"sst_ros/mechanism/direct_kinematics.py"}
"""The companion matrix of a polynomial is the field's term."""
FILES = sorted(
    str(path.relative_to(ROOT))
    for folder, kind in (("sst_ros", "*.py"), ("docs", "*.md"), ("launch", "*.py"), (".", "*.md"))
    for path in ((ROOT / folder).glob(kind) if folder == "." else (ROOT / folder).rglob(kind))
    if path.name != "CHANGELOG.md"
)


@pytest.mark.parametrize("name", FILES)
def test_a_text_is_in_plain_terms(name):
    if name in ALLOWED:
        return
    text = (ROOT / name).read_text(encoding="utf-8")
    assert [match.group() for match in PATTERN.finditer(text)] == []
