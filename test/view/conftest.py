# SPDX-License-Identifier: Apache-2.0
"""One server for all tests of the page."""

import pytest


@pytest.fixture(scope="session")
def server():
    """A page without a source."""
    from sst_ros.view.server import PageServer

    running = PageServer(port=18280)
    yield running
    running.stop()
