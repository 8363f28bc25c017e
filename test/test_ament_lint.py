# SPDX-License-Identifier: Apache-2.0
"""The linters of a ROS installation, as `colcon test` runs them.

Exceptions with their reasons.

`make lint` checks the same and more with ruff, on any machine.
"""

import configparser
import os
import socket
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("sst_ros", "launch", "tools")
PYTHON = (*FOLDERS, "test", "benchmark", "examples")
LONG_EQUATIONS = ("test_paper_equations.py",)
"""Files that setup.cfg excepts from E501."""
PEP257_EXCEPTIONS = (
    "D213",  # the summary is on the first line of the docstring (D212)
    "D401",  # also asked of properties, which are nouns; ruff asks it of functions only
    "D403",  # "QoS"
    "D406",  # sections are those of Google's style, without underlines
    "D407",
)


LINTERS = {
    # Its exceptions: setup.cfg.
    "ament_flake8": ("--config", "setup.cfg", "setup.py", *PYTHON),
    "ament_pep257": (*FOLDERS, "setup.py", "--add-ignore", *PEP257_EXCEPTIONS),
    "ament_xmllint": ("config", "sst_ros/nodes"),
}
SCHEMA_HOST = "download.ros.org"


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", LINTERS)
def test_nothing_is_found(name, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    linter = pytest.importorskip(
        f"{name}.main", reason=f"needs {name} of a ROS installation"
    )
    assert linter.main(argv=[*LINTERS[name]]) == 0, capsys.readouterr()


def test_package_xml_follows_its_schema(monkeypatch, capsys):
    """The schema is at ROS, or in a catalog that XML_CATALOG_FILES names."""
    reason = "needs ament_xmllint of a ROS installation"
    linter = pytest.importorskip("ament_xmllint.main", reason=reason)
    if "XML_CATALOG_FILES" not in os.environ:
        try:
            socket.create_connection((SCHEMA_HOST, 80), timeout=5.0).close()
        except OSError:
            pytest.skip(f"needs {SCHEMA_HOST} or XML_CATALOG_FILES, for the schema")
    monkeypatch.chdir(ROOT)
    assert linter.main(argv=["package.xml"]) == 0, capsys.readouterr()


def test_copyright():
    """Sources have an SPDX line each, which ament_copyright does not know: it checks
    LICENSE.
    """
    reason = "needs ament_copyright of a ROS installation"
    found = pytest.importorskip("ament_copyright.parser", reason=reason).parse_file(
        ROOT / "LICENSE"
    )
    assert (found.exists, found.license_identifier) == (True, "apache2")


def test_no_line_is_longer_than_flake8_allows():
    """Ruff passes some lines that are: those of one word, and those with `noqa`."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    longest = int(config["flake8"]["max-line-length"])
    for path in (path for name in PYTHON for path in (ROOT / name).rglob("*.py")):
        if path.name not in LONG_EQUATIONS:
            lines = path.read_text("utf-8").splitlines()
            assert max(map(len, lines), default=0) <= longest, path


@pytest.mark.parametrize("folder", PYTHON)
def test_each_source_file_names_its_licence(folder):
    texts = {path: path.read_text("utf-8") for path in (ROOT / folder).rglob("*.py")}
    assert texts
    for path, text in texts.items():
        assert not text or "SPDX-License-Identifier: Apache-2.0" in text[:400], path
