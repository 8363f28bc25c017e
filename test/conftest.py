# SPDX-License-Identifier: Apache-2.0
"""Fixtures for all rooms: a run of Example 2, as messages and as a recording."""

import os

# Before NumPy is imported: OpenBLAS's threads wait for each other where workers share
# the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import contextlib
import itertools

import hypothesis
import pytest

from benchmark.plain_python import without_llvmlite
from sst_ros.dynamics import kernel, traced_dynamics
from sst_ros.integration import batch
from sst_ros.scene import scene

# By its default an example of 0.2 s is a failure: on a loaded machine any may take that
# long.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

pytest_plugins = [
    "pytester",
    "colcon_choice",
    "missing_packages",
    "unexpected_skips",
    "repeat_failures",
]


def pytest_pycollect_makemodule(module_path, parent):
    """Import a module when it is collected.

    launch_testing's plugin does it while it looks.

    A module that skips itself then skips its whole folder.
    """
    from missing_packages import TestModule

    return TestModule.from_parent(parent, path=module_path)


@pytest.fixture(scope="session")
def browser():
    """One Chromium for all tests, each of which opens its page in it."""
    from tools.browser import browse

    with browse() as started:
        yield started


@pytest.fixture(scope="session")
def bags():
    """Helpers that make and write messages of a run; they need rosbags."""
    import bags

    return bags


@pytest.fixture(scope="session")
def example2(bags):
    """Messages of 0.3 s of Example 2."""
    return bags.simulated(scene.load("example2"), 0.3)


@pytest.fixture(scope="session")
def example2_bag(tmp_path_factory, bags, example2):
    """A recording of `example2`, which no test changes."""
    return bags.write(tmp_path_factory.mktemp("example2") / "bag", example2)


@pytest.fixture
def read(written):
    """Write messages in the order of their reception, and read them as a recording."""
    from sst_ros.recording import recording

    return lambda entries, **options: recording.read(
        written(sorted(entries, key=lambda entry: entry.received_ns), **options)
    )


@pytest.fixture
def written(bags, tmp_path):
    """Write messages into a new folder and return its path."""
    names = (f"bag{number or ''}" for number in itertools.count())
    return lambda entries, **options: bags.write(
        tmp_path / next(names), entries, **options
    )


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made, but not rendered: their files are empty."""
    from matplotlib.figure import Figure

    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)


@pytest.fixture
def wrong_kernel(monkeypatch):
    """Falsify what the kernel's derivative gives, and what has been traced from it or
    will be.
    """
    right = kernel.derivative

    def forget():
        traced_dynamics.recent.cache_clear()
        batch.programs_of.cache_clear()

    def put(wrong):
        monkeypatch.setattr(kernel, "derivative", lambda *given: wrong(right(*given)))
        forget()

    yield put
    forget()


@pytest.fixture
def without_machine_code():
    """Run what is made from the call on as without llvmlite, to the end of the test."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(without_llvmlite())
