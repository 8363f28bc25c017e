# SPDX-License-Identifier: Apache-2.0
"""Every block of every page runs, or is checked where it needs a ROS installation."""

import contextlib
import json
import re
import shlex
from pathlib import Path

import pytest
from docs.blocks import ROOT, blocks, links, pages, prose
from programs import own_domain

from sst_ros.cli.commands import NODE_HELP, parser

PAGES = pages()
LONG = (
    "README batch collocation controller designers embed equations evaluate fast"
    " faults follow geometry gpu identify index linearize lockstep look many nodes"
    " own_loads plot proof reactions record rodas5p runge_kutta simulate sweep torque"
    " twelve_tasks work_precision"
)
"""Pages that start nodes or runs, which other tests do as well, or that compile."""
WITH_BLOCKS = [
    (
        pytest.param(page, marks=pytest.mark.slow)
        if Path(page).stem in LONG.split()
        else page
    )
    for page in PAGES
    if blocks(page)
]


@pytest.mark.ros
@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", WITH_BLOCKS)
def test_every_block_of_a_page_runs(page, tmp_path):
    pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    if "parquet" in (ROOT / page).read_text(encoding="utf-8"):
        pytest.importorskip("pyarrow", reason="needs pyarrow: pip install .[record]")
    from docs.session import Session

    with (
        own_domain() as domain,
        contextlib.closing(Session(tmp_path, domain)) as session,
    ):
        for block in blocks(page):
            session.run(block)
        session.settle()


def test_each_of_the_twelve_tasks_is_a_short_block_or_a_link():
    page, shown = (
        "docs/howto/twelve_tasks.md",
        ROOT / "docs" / "tutorial" / "first_steps.ipynb",
    )
    text = (ROOT / page).read_text(encoding="utf-8")
    tasks = re.split(r"^## \d+\. ", text, flags=re.M)[1:]
    assert len(tasks) == 12 and all("```" in task or "](" in task for task in tasks)
    linked = [f"docs/howto/{name}.md" for name in ("sweep", "linearize")]
    lines = [
        block.text.count("\n") for name in (page, *linked) for block in blocks(name)
    ]
    cells = json.loads(shown.read_text(encoding="utf-8"))["cells"]
    assert max(lines + [len(cell["source"]) for cell in cells]) <= 30


@pytest.mark.parametrize("page", PAGES)
def test_links_and_pictures_exist(page):
    folder, missing = (ROOT / page).parent, []
    for target in links(page):
        path, _, anchor = target.partition("#")
        place = folder / path if path else ROOT / page
        if not place.exists() or (anchor and anchor not in anchors(place)):
            missing.append(target)
    assert missing == []


def anchors(path):
    heads = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_are_commands(page):
    """`sst-ros ...` in running text names commands, options and nodes that exist."""
    for text in re.findall(r"`(?:sst-ros|python -m sst_ros) ([^`\n]+)`", prose(page)):
        words = shlex.split(text.replace("...", ""))
        if words[0] in NODE_HELP or words[0].isupper():
            continue
        of = parser()
        while (choices := _choices(of)) and words and not words[0].isupper():
            assert words[0] in choices, text
            of = choices[words.pop(0)]
        options = {option for action in of._actions for option in action.option_strings}
        assert {word for word in words if word.startswith("--")} <= options, text


def _choices(of):
    return next(
        (a.choices for a in of._actions if hasattr(a, "_choices_actions")), None
    )


def test_the_readme_is_short_and_begins_with_the_mechanism():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 135
    before, picture, after = text.partition("docs/mechanism.png")
    assert picture and len(before.splitlines()) < 20
    assert [
        line.split("  #")[0] for line in after.split("```")[1].split("\n")[1:3]
    ] == [
        "make demo",
        "make test",
    ]
    assert "```" not in before and "\n#" not in after[: after.index("make test")]


def test_every_page_is_in_the_site():
    """All but the README are listed in an index, so that nobody has to guess an
    address.
    """
    listed, docs = {"index"}, ROOT / "docs"
    for index in docs.rglob("index.md"):
        folder = index.parent.relative_to(docs)
        for block in blocks(str(index.relative_to(ROOT))):
            if block.language == "{toctree}":
                entries = re.findall(r"^[\w/]+$", block.text, re.M)
                listed |= {(folder / entry).as_posix() for entry in entries}
    there = {
        path.relative_to(docs)
        for kind in ("md", "ipynb")
        for path in docs.rglob(f"*.{kind}")
    }
    there = {
        path.with_suffix("").as_posix()
        for path in there
        if path.parts[0] not in ("gallery", "joss")  # joss: a draft for a journal
    }
    assert listed == there | {"gallery/index"}


@pytest.mark.parametrize("page", ["columns.md", "commands.md", "nodes.md", "scenes.md"])
def test_generated_tables_are_those_of_the_declarations(page):
    pytest.importorskip("rclpy", reason="needs rclpy: pip install .[ros]")
    from tools.reference_pages import PAGES as generated
    from tools.reference_pages import fill

    assert page in generated and len(generated) == 4
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert fill(page, text) == text, "run python -m tools.reference_pages"
