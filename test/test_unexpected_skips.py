# SPDX-License-Identifier: Apache-2.0
"""A skip that nobody expects fails the session where CI=true."""

import pytest

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
        (TEST.format(reason="no chromium with chromedriver on the PATH"), "true", (), 0),
        (TEST.format(reason="numba is missing"), "true", (), 1),
        (TEST.format(reason="numba is missing"), "true", ("-n", "1"), 1),
        (TEST.format(reason="numba is missing"), "false", (), 0),
        (MODULE, "true", (), 1),
    ],
    ids=["expected", "unexpected", "of a worker", "elsewhere", "module"],
)
def test_an_unexpected_skip_fails(pytester, monkeypatch, source, ci, workers, status):
    monkeypatch.setenv("CI", ci)
    pytester.makepyfile(test_it=source)
    done = pytester.runpytest_inprocess("-q", "-p", "unexpected_skips", *workers)
    assert (done.ret, "UNEXPECTED SKIP" in done.stdout.str()) == (status, status == 1)
