# SPDX-License-Identifier: Apache-2.0
"""A test whose import needs an optional package that is not installed is skipped, not
failed.

`colcon test` runs with the packages of rosdep, which has no keys for mcap, rosbags and
others. With CI=true such a skip fails the session: see unexpected_skips.py.
"""

import importlib.util

import pytest

from sst_ros.errors import explanation


def skip_if_missing(error):
    """Skip at an ImportError of an optional package, with what installs it."""
    if isinstance(error, ImportError) and (how := explanation(error)):
        pytest.skip(how, allow_module_level=True)


def needs(*modules):
    """Mark a test whose commands or child processes need optional packages.

    Its own imports need no mark: see the hooks below.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    reasons = [explanation(ModuleNotFoundError(name=name)) or name for name in missing]
    return pytest.mark.skipif(bool(missing), reason="; ".join(reasons))


class TestModule(pytest.Module):
    """A module of tests that is skipped where it cannot import an optional package."""

    def collect(self):
        try:
            return super().collect()
        except self.CollectError as error:
            skip_if_missing(error.__cause__)
            raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    try:
        return (yield)
    except ImportError as error:
        skip_if_missing(error)
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    try:
        return (yield)
    except ImportError as error:
        skip_if_missing(error)
        raise
