# SPDX-License-Identifier: Apache-2.0
"""With CI=true, a test that is skipped for a reason that is not listed here fails the
session.
"""

import os

ALLOWED = (
    "long doubles are doubles here",
    "needs /dev/full",
    "/dev/cpu_dma_latency may not be written here",
    "needs root to act as a second user",
    "of a ROS installation",
    "no C compiler",
    "no C++ compiler",
    "no chromium with chromedriver on the PATH",
    "with the rclpy of Jazzy",
)


class UnexpectedSkips:
    """Collects skipped tests and modules, and fails the session if one of them should
    run.
    """

    def __init__(self):
        self.found = []

    def pytest_runtest_logreport(self, report):
        if report.skipped and not hasattr(report, "wasxfail"):
            reason = (
                report.longrepr[2]
                if isinstance(report.longrepr, tuple)
                else report.longrepr
            )
            if not any(allowed in str(reason) for allowed in ALLOWED):
                self.found.append(f"{report.nodeid}: {reason}")

    pytest_collectreport = pytest_runtest_logreport

    def pytest_sessionfinish(self, session):
        if self.found:
            session.exitstatus = 1

    def pytest_terminal_summary(self, terminalreporter):
        for skipped in self.found:
            terminalreporter.write_line(f"UNEXPECTED SKIP {skipped}", red=True)


def pytest_configure(config):
    if os.environ.get("CI") == "true" and not hasattr(config, "workerinput"):
        config.pluginmanager.register(UnexpectedSkips())
