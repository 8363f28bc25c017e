# SPDX-License-Identifier: Apache-2.0
"""What bloom reads, and the parsers that it uses: package.xml and CHANGELOG.rst."""

import re
from pathlib import Path

import pytest

from sst_ros import __version__
from tools import changelog_rst

ROOT = Path(__file__).parents[1]
MARKDOWN = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
RST = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")


def test_the_changelogs_agree():
    assert changelog_rst.text(MARKDOWN) == RST, "run python -m tools.changelog_rst"


def test_the_parser_of_bloom_reads_every_release():
    changelog = pytest.importorskip("catkin_pkg.changelog").get_changelog_from_path(ROOT, "sst_ros")
    read = {version: (date, content) for version, date, content in changelog.foreach_version()}
    assert list(read) == re.findall(r"^## \[(\d\S+)\] - ", MARKDOWN, re.M)
    date, content = read[__version__]
    assert f"## [{__version__}] - {date.date()}" in MARKDOWN
    released = MARKDOWN.partition(f"## [{__version__}]")[2].partition("\n## ")[0]
    items = [item for bullets in content if hasattr(bullets, "bullets") for item in bullets.bullets]
    assert len(items) == len(re.findall(r"^- ", released, re.M)) > 10


def test_the_changelog_is_restructured_text():
    core = pytest.importorskip("docutils.core")
    core.publish_doctree(RST, settings_overrides={"report_level": 1, "halt_level": 1})


def test_an_unreleased_section_and_links_at_the_end_stay_out():
    text = changelog_rst.text(
        "# Changelog\n\n## [Unreleased]\n\n- Not yet.\n\n## [1.2.3] - 2026-01-02\n\n### Fixed\n\n"
        "- A `code\n  span` and [a page](https://a.b/c).\n\n## [1.2.2] - 2026-01-01\n\n- First.\n\n"
        "[1.2.3]: https://a.b\n"
    )
    assert "1.2.3 (2026-01-02)\n------------------\n\n**Fixed**\n\n- A ``code span``" in text
    assert "`a page <https://a.b/c>`__" in text
    assert text.endswith("1.2.2 (2026-01-01)\n------------------\n\n- First.\n")
    assert "Not yet" not in text


def test_package_xml_is_valid():
    package = pytest.importorskip("catkin_pkg.package")
    warnings = []
    parsed = package.parse_package(ROOT, warnings=warnings)
    parsed.validate(warnings)
    assert warnings == []
    assert (parsed.version, parsed.get_build_type()) == (__version__, "ament_python")
