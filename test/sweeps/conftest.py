# SPDX-License-Identifier: Apache-2.0
"""A cache of compiled code that the tests of studies share, apart from the user's."""

import pytest


@pytest.fixture(scope="session")
def cache_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def cache(cache_folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SST_ROS_CACHE", str(cache_folder))
        yield
