# SPDX-License-Identifier: Apache-2.0
"""One version, the extras, and what a wheel and a source distribution install."""

import os
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
import yaml

import sst_ros
from sst_ros.cli.commands import NODES
from sst_ros.extras import EXTRAS

ROOT = Path(__file__).parents[1]


def test_the_version_is_the_same_everywhere():
    package = re.search("<version>(.*)</version>", (ROOT / "package.xml").read_text())
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert sst_ros.__version__ == package[1] == citation["version"]


def test_every_extra_that_a_message_names_brings_the_module():
    setup = (ROOT / "setup.py").read_text()
    for module, extra in EXTRAS.items():
        assert f'"{extra}"' in setup
        if module not in ("lz4", "zstandard"):  # brought by rosbags
            names = {"pinocchio": "pin>=", "distributed": "dask[distributed]"}
            package = names.get(module, module)
            assert f'"{package}' in setup


def test_every_node_has_an_executable_for_ros2_run():
    assert {path.name for path in (ROOT / "executables").iterdir()} == set(NODES)
    assert all(os.access(ROOT / "executables" / name, os.X_OK) for name in NODES)


def check_installed(python, folder):
    """Try what an installation without any extra offers, from a folder that is not the source."""
    environment = {**os.environ, "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTHONPATH", None)

    def run(*words):
        return subprocess.run(
            words, cwd=folder, env=environment, capture_output=True, text=True, timeout=120
        )

    command = python.parent / "sst-ros"
    assert sorted(p.name for p in python.parent.iterdir() if p.name in (*NODES, "sst-ros")) == [
        "sst-ros"
    ]
    assert run(command, "--version").stdout == f"sst-ros {sst_ros.__version__}\n"
    assert "example2" in run(command, "scene", "list").stdout
    done = run(command, "simulate", "example2", "--duration", "0.01", "--method", "dopri5")
    assert done.returncode == 0, done.stderr
    assert "reached the end" in done.stdout
    for words in (["simulator"], ["plot", "bag"], ["view", "bag"], ["compile"], ["demo"],
                  ["export", "bag"], ["report", "run", "bag"], ["workspace", "example2"],
                  ["recorder"]):  # fmt: skip
        done = run(command, *words)
        assert done.returncode == 1, words
        assert re.fullmatch(r"sst-ros: \w+ is not installed: .*\n", done.stderr), done.stderr
    for name in NODES:
        node = python.parents[1] / "lib" / "sst_ros" / name
        done = run(node)
        assert done.returncode == 1
        assert re.fullmatch(r"sst-ros: \w+ is not installed: .*\n", done.stderr), done.stderr
    code = (
        "import sst_ros as s, pathlib; print((pathlib.Path(s.__path__[0]) / 'py.typed').exists())"
    )
    typed = run(python, "-c", code)
    assert typed.stdout == "True\n", typed.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_an_installation_without_extras_works(kind, tmp_path):
    for needed in ("build", "twine"):
        pytest.importorskip(needed, reason=f"needs {needed}: pip install .[test]")
    source = tmp_path / "source"
    ignored = shutil.ignore_patterns(".*", "*_out", "__pycache__", "*.egg-info", "build", "site")
    shutil.copytree(ROOT, source, ignore=ignored)
    subprocess.run(
        [sys.executable, "-m", "build", f"--{kind}", "--outdir", tmp_path / "dist", source],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    (built,) = (tmp_path / "dist").iterdir()
    check = [sys.executable, "-m", "twine", "check", "--strict", built]  # the description renders
    checked = subprocess.run(check, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    venv.create(tmp_path / "fresh", with_pip=True)
    python = tmp_path / "fresh" / "bin" / "python"
    subprocess.run(
        [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", built],
        check=True, timeout=300,
    )  # fmt: skip
    check_installed(python, tmp_path)
