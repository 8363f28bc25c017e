# SPDX-License-Identifier: Apache-2.0
"""The site: built without a warning, complete, found by search, without traces of its
tools.
"""

import html
import json
import re
import subprocess
import sys

import pytest
from docs.blocks import ROOT

import sst_ros

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
FOUND = {
    "monte": "howto/batch",
    "carlo": "howto/batch",
    "gravity": "howto/follow",
    "computed": "howto/follow",
    "hold": "howto/command",
    "diagram": "howto/work_precision",
    "lockstep": "howto/lockstep",
}
"""Words that a reader searches for, and a page whose title must have them (stems, as
indexed).
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build it by the command of `make docs`."""
    for needed in ("furo", "myst_nb", "sphinx_gallery"):
        pytest.importorskip(needed, reason="needs the extra docs: pip install .[docs]")
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8").partition("\ndocs:")[2]
    words = recipe.partition("$(RUN) -m sphinx ")[2].partition(" $$site")[0].split()
    assert words[-1] == "docs" and "--fail-on-warning" in words
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", *words, str(folder)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.fixture(scope="module")
def index(site):
    """What the search of the site knows."""
    text = (site / "searchindex.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))


def shown(text):
    """Text that a reader of a page sees."""
    body = re.sub(r"<(script|style)\b.*?</\1>|<!--.*?-->", "", text, flags=re.S)
    return html.unescape(re.sub(r"<[^>]+>", "", body))


def test_a_page_fetches_nothing_and_names_the_release_only(site):
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(
            r"<(?:script|img|link)\b[^>]*(?:src|href)=\"(https?:[^\"]*)\"", text
        )
        assert fetched == [], page.name
        assert f"sst_ros {sst_ros.__version__}" in text, page.name
        traces = r"do not edit|rather than edit|%\(default\)s|AUTOMATICALLY"
        assert not re.search(traces, shown(text), re.I), page.name
    assert "<math" in (site / "theory.html").read_text(encoding="utf-8")
    assert "function derivative(" in (site / "_static/live_equations.js").read_text()


@pytest.mark.parametrize(("word", "page"), FOUND.items())
def test_search_finds_a_term_of_the_field_in_a_title(index, word, page):
    from snowballstemmer import stemmer

    stem = stemmer("porter").stemWord(word)
    hits = index["titleterms"].get(word) or index["titleterms"][stem]
    assert page in [
        index["docnames"][hit] for hit in (hits if isinstance(hits, list) else [hits])
    ]


def test_search_finds_public_names(index):
    objects = {entry[-1] for entries in index["objects"].values() for entry in entries}
    assert {"gravity_torque", *sst_ros.__all__} - {"__version__"} <= objects


def test_the_gallery_has_twelve_pictures_or_more_with_their_code(site):
    texts = [
        page.read_text()
        for page in (site / "gallery").glob("*.html")
        if page.stem != "index"
    ]
    drawn = [text for text in texts if "sphx_glr_" in text and "_001.png" in text]
    assert len(drawn) >= 12
    assert all("highlight-Python" in text for text in drawn)
