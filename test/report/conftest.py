# SPDX-License-Identifier: Apache-2.0
"""Recordings of Example 2 as messages change them."""

import pytest

from sst_ros.recording import recording


@pytest.fixture
def read(written):
    """Write messages in the order of their reception, and read them as a recording."""
    return lambda entries: recording.read(
        written(sorted(entries, key=lambda entry: entry.received_ns))
    )
