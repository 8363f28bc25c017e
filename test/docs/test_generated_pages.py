# SPDX-License-Identifier: Apache-2.0
"""Published pages of studies are those of this program: same text, same cases, same scenes."""

import csv
import io
import re

import pytest
from docs.blocks import ROOT

from sst_ros.report import accuracy
from sst_ros.scene import scene as scenes
from studies import control_rate, extreme, extreme_cases


def stale(name, page, table):
    """What in a page, or in the table beside it, is not of this program."""
    rows = list(csv.DictReader(io.StringIO(table)))
    if name == "stability":
        introduction = extreme.INTRODUCTION
        wanted = {case.name for case in extreme_cases.catalogue()}
        found = {row["name"] for row in rows}
        if any(row["passed"] != "True" for row in rows):
            yield "a case failed"
        if any("False" in (row["same_bits"], row["run_loop"]) for row in rows):
            yield "a compiled run, or one through the run loop, differs"
        if not all(row["check"] for row in rows):
            yield "an error estimate that is neither checked nor explained"
    elif name == "accuracy":
        introduction, wanted = accuracy.INTRODUCTION, set(scenes.names())
        found = {row["scene"] for row in rows}
        if accuracy.TERMS_INTRODUCTION not in page:
            yield "the introduction of the costs of terms"
    else:
        introduction, wanted = control_rate.INTRODUCTION, set(control_rate.SCENES)
        found = {row["scene"] for row in rows}
        if "WARNING" in page:
            yield "an order is not that of theory"
    if introduction not in page:
        yield "the introduction"
    for entry in sorted(wanted ^ found):
        yield entry
    for entry in sorted(wanted):
        if not re.search(rf"^(\| |## |- ){re.escape(entry)}( \||$)", page, re.MULTILINE):
            yield f"not on the page: {entry}"


def published(name):
    return [(ROOT / "docs" / f"{name}.{kind}").read_text("utf-8") for kind in ("md", "csv")]


PAGES = ("accuracy", "control_rate", "stability")


@pytest.mark.parametrize("name", PAGES)
def test_a_published_page_is_that_of_this_program(name):
    assert list(stale(name, *published(name))) == []


@pytest.mark.parametrize("name", PAGES)
def test_a_stale_page_is_seen(name):
    page, table = published(name)
    lines = table.splitlines()
    entry = lines[-1].split(",")[0].strip('"')
    assert entry in list(stale(name, page, "\n".join(line for line in lines if entry not in line)))
    assert "the introduction" in list(stale(name, page.replace("figures", "numbers"), table))
