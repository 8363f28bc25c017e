# SPDX-License-Identifier: Apache-2.0
"""`make view` in a copy that has nothing yet: a page that moves within three minutes."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("selenium", reason="needs selenium: pip install .[test]")

from tools.browser import browse, chromium

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(chromium() is None, reason="no chromium with chromedriver on the PATH"),
]
SOURCE = Path(__file__).parents[2]
LIMIT_S = 180.0


def test_make_view(tmp_path, domain):
    ignored = shutil.ignore_patterns(".*", "*_out*", "__pycache__", "*.egg-info", "build", "site")
    copy = shutil.copytree(SOURCE, tmp_path / "sst_ros", ignore=ignored)
    began = time.monotonic()
    # A session of its own: Ctrl-C in a terminal reaches make, the page and the simulator.
    process = subprocess.Popen(
        ["make", "view", f"PYTHON={sys.executable}"],
        cwd=copy,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        lines = iter(process.stdout.readline, "")
        url = next(filter(None, (re.search(r"http://\S+", line) for line in lines))).group()
        with browse() as page:
            page.open(url, (820, 560))
            page.until(lambda: page.time() is not None, "time of a run")
            first = page.time()
            page.until(lambda: page.time() > first, "motion")
            taken = time.monotonic() - began
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert "Traceback" not in errors
    assert taken < LIMIT_S
    print(f"make view: a page that moves after {taken:.0f} s")
