# SPDX-License-Identifier: Apache-2.0
"""A test that fails names the command that repeats it alone, also when it ran in a
worker.
"""

import shlex
import sys
from pathlib import Path


def pytest_terminal_summary(terminalreporter):
    """Print a command for each test that failed, and for each file that could not be
    read.
    """
    failed = [
        report
        for kind in ("failed", "error")
        for report in terminalreporter.getreports(kind)
    ]
    python = Path(sys.executable)
    if python.is_relative_to(terminalreporter.config.rootpath):  # and so shorter
        python = python.relative_to(terminalreporter.config.rootpath)
    for name in dict.fromkeys(report.nodeid for report in failed):
        terminalreporter.write_line(
            "repeat: " + shlex.join([str(python), "-m", "pytest", name])
        )
