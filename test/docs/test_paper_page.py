# SPDX-License-Identifier: Apache-2.0
"""The page that goes through the paper is what its generator writes, and covers all of it."""

import importlib

import pytest
from mechanism.test_paper_equations import RESIDUALS

from tools import mechanism_figures, paper_page


def test_the_page_is_up_to_date():
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
    (room / "virtual_work.py").write_text(source.replace("def link_frames", "def frames_of_links"))
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
