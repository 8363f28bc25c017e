# SPDX-License-Identifier: Apache-2.0
"""A skip that nobody expects fails the session where CI=true."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest

def test_runs():
    pass

@pytest.mark.skipif(True, reason={reason!r})
def test_skipped():
    pass
"""


@pytest.mark.parametrize(
    ("reason", "ci", "workers", "status"),
    [
        ("no chromium with chromedriver on the PATH", "true", [], 0),
        ("numba is missing", "true", [], 1),
        ("numba is missing", "true", ["-n", "1"], 1),
        ("numba is missing", "false", [], 0),
    ],
)
def test_an_unexpected_skip_fails(reason, ci, workers, status, tmp_path):
    (tmp_path / "test_it.py").write_text(TESTS.format(reason=reason))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "unexpected_skips", *workers, tmp_path],
        cwd=tmp_path,
        env={**os.environ, "CI": ci, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert done.returncode == status, done.stdout
    assert ("UNEXPECTED SKIP" in done.stdout) == (status == 1)


def test_an_unexpected_skip_of_a_module_fails(tmp_path):
    (tmp_path / "test_it.py").write_text("import pytest\npytest.importorskip('no_such_module')\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "unexpected_skips", tmp_path],
        cwd=tmp_path,
        env={**os.environ, "CI": "true", "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert done.returncode == 1
    assert "UNEXPECTED SKIP test_it.py" in done.stdout
