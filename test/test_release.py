# SPDX-License-Identifier: Apache-2.0
"""docs/release.md, step by step, in a clone.

The conda recipe and pixi.toml beside setup.py.
"""

import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
from datetime import date
from pathlib import Path

import pytest
import yaml

import sst_ros
from tools import changelog_rst, metadata

tomllib = importlib.import_module(
    "tomllib" if sys.version_info >= (3, 11) else "pip._vendor.tomli"
)

ROOT = Path(__file__).parents[1]
STEPS = re.findall(
    r"^ *```bash\n(.*?)^ *```$",
    (ROOT / "docs/release.md").read_text(encoding="utf-8"),
    re.M | re.S,
)
PUBLISHES = ("git push", "git -C", "twine upload", "bloom-release", "rattler-build")
"""Commands that are not run here, nor part of the extra `test`."""


def dry(command):
    """What stands for a command that takes hours, in the test.

    "" for one that publishes.
    """
    if command.startswith(PUBLISHES):
        return ""
    if command.startswith("make "):
        return (
            f"make --dry-run PYTHON={sys.executable} {command.removeprefix('make ')} >"
            " /dev/null"
        )
    if command.endswith("--filled"):  # what only a person fills in is refused
        return f"! {command} 2> /dev/null"
    if module := re.match(r"python -m benchmark\.\w+", command):
        return f"{module[0]} --help > /dev/null"
    return command


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_page_of_the_release_in_a_clone(tmp_path):
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(
        ".*", "*_out", "__pycache__", "*.egg-info", "build", "site"
    )
    shutil.copytree(ROOT, source, ignore=ignored)
    commands = [line.strip() for step in STEPS for line in step.splitlines()]
    assert len(commands) == 29 and sum(not dry(command) for command in commands) == 8
    git = [
        "git init --quiet",
        "git add --all",
        "git config user.name A",
        "git config user.email a@b",
    ]
    script = "\n".join(["set -e", *git, *filter(None, map(dry, commands))])
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    author = {"GIT_AUTHOR_NAME": "A", "GIT_AUTHOR_EMAIL": "a@b"}
    author |= {"GIT_COMMITTER_NAME": "A", "GIT_COMMITTER_EMAIL": "a@b"}
    kept = {
        k: v
        for k, v in os.environ.items()
        if k != "PYTHONPATH" and not k.startswith("PYTEST")
    }
    done = subprocess.run(
        ["bash", "-c", script], cwd=source, env={**kept, **author, "PATH": path},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "reached the end" in done.stdout
    tags = subprocess.run(
        ["git", "tag"], cwd=source, capture_output=True, text=True
    ).stdout
    version = metadata.next_version()
    assert tags == f"v{version}\n"
    assert {path.name for path in (source / "dist").iterdir()} == {
        f"sst_ros-{version}-py3-none-any.whl", f"sst_ros-{version}.tar.gz",
    }  # fmt: skip
    hardware = (tmp_path / "sst_ros_hardware", "tag")
    tags = subprocess.run(
        ["git", "-C", *hardware], capture_output=True, text=True
    ).stdout
    assert tags == f"{version}\n"
    for changelog in (source / "CHANGELOG.rst", hardware[0] / "CHANGELOG.rst"):
        assert f"\n{version} (20" in changelog.read_text(encoding="utf-8")


def test_the_next_version_is_the_next_minor_one(capsys, monkeypatch):
    monkeypatch.setattr(metadata, "version", lambda: "1.9.3")
    monkeypatch.setattr(sys, "argv", ["metadata", "--next"])
    assert metadata.main() == 0 and capsys.readouterr().out == "1.10.0\n"


def test_a_changelog_of_hardware_without_news_has_its_version():
    title = "^^^\nABC\n^^^\n\n"
    before = f"{title}Forthcoming\n-----\n\n* News.\n"
    day = date(2026, 11, 27)
    once = changelog_rst.date_hardware(before, "0.2.0", day)
    assert once == f"{title}0.2.0 (2026-11-27)\n------------------\n\n* News.\n"
    twice = changelog_rst.date_hardware(once, "0.3.0", day)
    head = "0.3.0 (2026-11-27)\n------------------\n\n* No changes.\n\n"
    assert twice == title + head + once.removeprefix(title)


def test_a_version_is_released_once():
    markdown = "# Changelog\n\n## [Unreleased]\n\n### Added\n\n- News.\n"
    day = date(2026, 11, 27)
    once = changelog_rst.date_markdown(markdown, "0.2.0", day)
    assert "## [Unreleased]\n\n## [0.2.0] - 2026-11-27\n\n### Added" in once
    with pytest.raises(ValueError, match="none of 0"):
        changelog_rst.date_markdown(once, "0.2.0", day)


def test_conda_and_pixi_ask_for_what_setup_py_asks_for(monkeypatch):
    given = {}
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("setuptools.setup", given.update)
    runpy.run_path("setup.py")
    needed = dict(one.lower().split(">=") for one in given["install_requires"])
    needed["python"] = given["python_requires"].removeprefix(">=")
    recipe = yaml.safe_load((ROOT / "conda/recipe.yaml").read_text(encoding="utf-8"))
    pixi = tomllib.loads((ROOT / "pixi.toml").read_text(encoding="utf-8"))
    assert dict(one.split(" >=") for one in recipe["requirements"]["run"]) == needed
    bounds = {
        name: text.removeprefix(">=").partition(",")[0]
        for name, text in pixi["dependencies"].items()
    }
    assert bounds == needed
    assert (
        recipe["context"]["version"]
        == pixi["workspace"]["version"]
        == sst_ros.__version__
    )
    scripts = given["entry_points"]["console_scripts"]
    assert recipe["build"]["python"]["entry_points"] == scripts
    features = [pixi, *pixi["feature"].values()]
    extras = {
        extra
        for one in features
        for extra in one["pypi-dependencies"]["sst_ros"]["extras"]
    }
    assert extras <= set(given["extras_require"])
