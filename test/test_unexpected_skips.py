# SPDX-License-Identifier: Apache-2.0
"""A skip that nobody expects fails where CI=true.

A failure names the command that repeats it.
"""

import importlib.util
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from slow_cases import slow_after

needs_workers = pytest.mark.skipif(
    importlib.util.find_spec("xdist") is None, reason="pytest-xdist is missing"
)

TEST = """
import pytest

def test_runs():
    pass

@pytest.mark.skipif(True, reason={reason!r})
def test_skipped():
    pass
"""
MODULE = "import pytest\npytest.importorskip('no_such_module')\n"


@pytest.mark.parametrize(
    ("source", "ci", "workers", "status"),
    [
        (
            TEST.format(reason="no chromium with chromedriver on the PATH"),
            "true",
            (),
            0,
        ),
        (TEST.format(reason="llvmlite is missing"), "true", (), 1),
        pytest.param(
            *(TEST.format(reason="llvmlite is missing"), "true", ("-n", "1"), 1),
            marks=[needs_workers, pytest.mark.slow],
        ),
        (TEST.format(reason="llvmlite is missing"), "false", (), 0),
        (MODULE, "true", (), 1),
    ],
    ids=["expected", "unexpected", "of a worker", "elsewhere", "module"],
)
def test_an_unexpected_skip_fails(pytester, monkeypatch, source, ci, workers, status):
    monkeypatch.setenv("CI", ci)
    pytester.makepyfile(test_it=source)
    done = pytester.runpytest_inprocess("-q", "-p", "unexpected_skips", *workers)
    assert (done.ret, "UNEXPECTED SKIP" in done.stdout.str()) == (status, status == 1)


FAILS = """
import pytest

@pytest.mark.parametrize("name", ["it's", "fine"])
def test_fails(name):
    assert name == "fine"
"""


@pytest.mark.parametrize(
    "workers",
    slow_after(1, [(), pytest.param(("-n", "1"), marks=needs_workers)]),
    ids=["alone", "of a worker"],
)
def test_a_failure_names_the_command_that_repeats_it_alone(pytester, workers):
    pytester.makepyfile(test_it=FAILS)
    done = pytester.runpytest_inprocess("-q", "-p", "repeat_failures", *workers)
    (line,) = [line for line in done.stdout.lines if line.startswith("repeat: ")]
    again = subprocess.run(
        line.removeprefix("repeat: "),
        shell=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert again.returncode == 1 and "1 failed in" in again.stdout, again.stdout
    assert shlex.split(line)[-1] == "test_it.py::test_fails[it's]"


def test_readme_says_how_many_tests_there_are(request):
    """About: the twentieth that has nodes runs apart."""
    found = len(request.session.items)
    if found < 2000:
        pytest.skip("a part of the tests was chosen")
    if importlib.util.find_spec("rosbags") is None:
        pytest.skip("modules that need optional packages are not counted")
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (said,) = re.findall(r"make test .*types, ([\d,]+) tests", text)
    assert 0.9 < found / int(said.replace(",", "")) <= 1.0
