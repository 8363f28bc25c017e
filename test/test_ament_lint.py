# SPDX-License-Identifier: Apache-2.0
"""The linters of a ROS installation, as `colcon test` runs them; exceptions with their reasons.

`make lint` checks the same and more with ruff, on any machine.
"""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("sst_ros", "launch", "tools")
PEP257_EXCEPTIONS = (
    "D213",  # the summary is on the first line of the docstring (D212)
    "D401",  # also asked of properties, which are nouns; ruff asks it of functions only
    "D403",  # "QoS"
    "D406",  # sections are those of Google's style, without underlines
    "D407",
)


@pytest.fixture
def linter(monkeypatch):
    """Return a function that imports the main module of a linter."""
    monkeypatch.chdir(ROOT)

    def main(name):
        return pytest.importorskip(f"{name}.main", reason=f"needs {name} of a ROS installation")

    return main


@pytest.mark.timeout(600)
def test_flake8(linter):
    """Exceptions: setup.cfg."""
    words = ["--config", "setup.cfg", *FOLDERS, "setup.py", "test", "benchmark", "examples"]
    status, errors = linter("ament_flake8").main_with_errors(argv=words)
    assert status == 0, "\n".join(errors)


@pytest.mark.timeout(300)
def test_pep257(linter, capsys):
    words = [*FOLDERS, "setup.py", "--add-ignore", *PEP257_EXCEPTIONS]
    assert linter("ament_pep257").main(argv=words) == 0, capsys.readouterr().err


def test_xmllint(linter, capsys):
    """Validates package.xml by its schema; without a network it needs XML_CATALOG_FILES."""
    assert linter("ament_xmllint").main(argv=["package.xml", "config", "sst_ros"]) == 0, (
        capsys.readouterr().err
    )


def test_copyright(linter):
    """Sources have an SPDX line each, which ament_copyright does not know: it checks LICENSE."""
    linter("ament_copyright")
    from ament_copyright.parser import parse_file

    found = parse_file("LICENSE")
    assert (found.exists, found.license_identifier) == (True, "apache2")


@pytest.mark.parametrize("folder", [*FOLDERS, "test", "benchmark", "examples"])
def test_each_source_file_names_its_licence(folder):
    texts = {path: path.read_text("utf-8") for path in (ROOT / folder).rglob("*.py")}
    assert texts
    for path, text in texts.items():
        assert not text or "SPDX-License-Identifier: Apache-2.0" in text[:400], path
