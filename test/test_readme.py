# SPDX-License-Identifier: Apache-2.0
"""What README.md says works."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_library_example_runs():
    (block,) = re.findall(r"```python\n(.*?)```", README, re.S)
    done = subprocess.run(
        [sys.executable, "-c", block], capture_output=True, text=True, cwd=ROOT, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("True") == 1  # one admissible assembly


@pytest.mark.parametrize(
    "words", re.findall(r"^\.venv/bin/python (-m sst_ros scene .*)$", README, re.M)
)
def test_scene_commands_run(words, tmp_path):
    mine = tmp_path / "my_scene.yaml"
    mine.write_text((ROOT / "config" / "scenes" / "example1.yaml").read_text())
    line = words.replace("my_scene.yaml", str(mine)).partition(" > ")[0]
    done = subprocess.run(
        [sys.executable, *shlex.split(line)], capture_output=True, text=True, cwd=ROOT, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_links_and_pictures_exist():
    found = re.findall(r"\]\(([^)h][^)]*)\)", README)
    assert found
    assert [link for link in found if not (ROOT / link).exists()] == []
