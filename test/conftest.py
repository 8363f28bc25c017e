# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all rooms: a run of Example 2, as messages and as a recording."""

import os

# Before NumPy is imported: OpenBLAS's threads wait for each other where workers share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest
from bags import bags, example2, example2_bag, read, written

from sst_ros.dynamics import kernel, traced_dynamics

# By its default an example of 0.2 s is a failure: on a loaded machine any may take that long.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

pytest_plugins = ["pytester", "unexpected_skips", "repeat_failures"]
__all__ = ["bags", "browser", "example2", "example2_bag", "read", "written", "wrong_kernel"]


def pytest_pycollect_makemodule(module_path, parent):
    """Import a module when it is collected; launch_testing's plugin does it while it looks.

    A module that skips itself then skips its whole folder.
    """
    return pytest.Module.from_parent(parent, path=module_path)


@pytest.fixture(scope="session")
def browser():
    """One Chromium for all tests, each of which opens its page in it."""
    from tools.browser import browse

    with browse() as started:
        yield started


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made, but not rendered: their files are empty."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)


@pytest.fixture
def wrong_kernel(monkeypatch):
    """Falsify what the kernel's derivative gives, and what has been traced from it or will be."""
    right = kernel.derivative

    def put(wrong):
        monkeypatch.setattr(kernel, "derivative", lambda *given: wrong(right(*given)))
        traced_dynamics.recent.cache_clear()

    yield put
    traced_dynamics.recent.cache_clear()
