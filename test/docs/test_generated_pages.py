# SPDX-License-Identifier: Apache-2.0
"""Published pages and pictures are those of this program: same text, cases, scenes,
equations.
"""

import csv
import importlib
import io
import re

import pytest
from docs.blocks import ROOT
from mechanism.test_paper_equations import RESIDUALS

from sst_ros.report import accuracy
from sst_ros.scene import scene as scenes
from studies import control_rate, extreme, extreme_cases
from tools import mechanism_figures, paper_page


def stale(name, page, table):
    """What in a page, or in the table beside it, is not of this program."""
    rows = list(csv.DictReader(io.StringIO(table)))
    if name == "stability":
        empty = extreme.page([])
        wanted = {case.name for case in extreme_cases.catalogue()}
        found = {row["name"] for row in rows}
        if any(row["passed"] != "True" for row in rows):
            yield "a case failed"
        if any("False" in (row["same_bits"], row["run_loop"]) for row in rows):
            yield "a compiled run, or one through the run loop, differs"
        if not all(row["check"] for row in rows):
            yield "an error estimate that is neither checked nor explained"
        if not all(row["proven"] for row in rows):
            yield "a case that is neither proven nor has a reason"
    elif name == "accuracy":
        empty = accuracy.accuracy_page([])
        wanted, found = set(scenes.names()), {row["scene"] for row in rows}
    else:
        empty, wanted = control_rate.page([]), set(control_rate.SCENES)
        found = {row["scene"] for row in rows}
        if "WARNING" in page:
            yield "an order is not that of theory"
    introduction, *_ = re.split(
        r"^(?:## |\*\*|sst_ros )", empty, maxsplit=1, flags=re.MULTILINE
    )
    if len(introduction) < 500 or introduction not in page:
        yield "the introduction"
    for entry in sorted(wanted ^ found):
        yield entry
    for entry in sorted(wanted):
        if not re.search(
            rf"^(\| |## |- ){re.escape(entry)}( \||$)", page, re.MULTILINE
        ):
            yield f"not on the page: {entry}"


def published(name):
    return [
        (ROOT / "docs" / f"{name}.{kind}").read_text("utf-8") for kind in ("md", "csv")
    ]


@pytest.mark.parametrize("name", ["accuracy", "control_rate", "stability"])
def test_a_published_page_is_that_of_this_program(name):
    assert list(stale(name, *published(name))) == []


def test_the_page_through_the_paper_is_what_its_generator_writes():
    text = paper_page.PAGE.read_text(encoding="utf-8")
    assert paper_page.page(text) == text


def test_every_equation_has_a_row_a_test_and_a_place_in_the_code():
    text = paper_page.PAGE.read_text(encoding="utf-8")
    rows = [int(number) for _, number in paper_page.ROW.findall(text)]
    assert rows == list(RESIDUALS) == list(range(1, 93))
    assert set(paper_page.places()) >= set(rows)


def test_a_renamed_function_changes_the_page(monkeypatch, tmp_path):
    room = tmp_path / "sst_ros" / "mechanism"
    room.mkdir(parents=True)
    source = (paper_page.ROOT / "sst_ros" / "mechanism" / "virtual_work.py").read_text()
    (room / "virtual_work.py").write_text(
        source.replace("def link_frames", "def frames_of_links")
    )
    monkeypatch.setattr(paper_page, "ROOT", tmp_path)
    assert paper_page.places()[51] == "`virtual_work.frames_of_links`"


@pytest.mark.parametrize("name", mechanism_figures.PICTURES)
def test_a_picture_of_the_mechanism_is_drawn(name, tmp_path):
    drawn = tmp_path / name
    mechanism_figures.PICTURES[name]().savefig(drawn, dpi=130)
    kept = (paper_page.PAGE.parent / name).read_bytes()
    assert drawn.read_bytes()[16:24] == kept[16:24]  # width and height
    assert len(drawn.read_bytes()) > 20_000


def test_the_flow_chart_names_functions_that_exist():
    for _, functions, _ in mechanism_figures.STEPS[1:]:
        module, function = functions.split(".")
        assert hasattr(importlib.import_module(f"sst_ros.mechanism.{module}"), function)
