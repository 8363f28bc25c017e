# SPDX-License-Identifier: Apache-2.0
"""One recording for all tests of the page."""

import bags
import pytest

from sst_ros.scene.scene import load


@pytest.fixture(scope="session")
def bag(tmp_path_factory):
    """A run of 0.3 s."""
    return bags.write(
        tmp_path_factory.mktemp("view") / "bag", bags.simulated(load("example2"), 0.3)
    )
