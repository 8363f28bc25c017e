# SPDX-License-Identifier: Apache-2.0
"""One recording and one server for all tests of the page."""

import bags
import pytest

from sst_ros.scene.scene import load


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    """A run of 0.3 s."""
    return bags.write(
        tmp_path_factory.mktemp("view") / "bag", bags.simulated(load("example2"), 0.3)
    )


@pytest.fixture(scope="session")
def server():
    """A page without a source."""
    from sst_ros.view.server import PageServer

    running = PageServer(port=18280)
    yield running
    running.stop()
