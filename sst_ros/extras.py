# SPDX-License-Identifier: Apache-2.0
"""Optional dependencies: which extra installs a module, and the error if it is missing."""

from __future__ import annotations

import importlib
from typing import Any

from sst_ros.errors import SstError

EXTRAS = {
    "distributed": "cluster",
    "lz4": "record",
    "matplotlib": "plot",
    "mcap": "record",
    "mpmath": "all",
    "numba": "fast",
    "pinocchio": "engines",
    "pandas": "record",
    "pyarrow": "record",
    "rosbags": "record",
    "viser": "view",
    "xarray": "all",
    "zstandard": "record",
}
"""Extra of this package that installs a module."""

_ROS = ("ament_index_python", "rclpy", "rcl_interfaces", "builtin_interfaces", "launch")
_ROS_SUFFIXES = ("_msgs", "_srvs")


class MissingDependency(SstError, ImportError):
    """An optional dependency is not installed; the message names the command that installs it."""


def require(module: str) -> Any:
    """Import an optional dependency.

    Raises:
        MissingDependency: it is not installed.

    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        message = explanation(error)
        if message is None:
            raise
        raise MissingDependency(message, name=error.name) from None


def explanation(error: ModuleNotFoundError) -> str | None:
    """Return how to install what is missing; None for a module that is no optional dependency."""
    module = (error.name or "").partition(".")[0]
    if module in _ROS or module.endswith(_ROS_SUFFIXES):
        return (
            f"{module} is not installed: source a ROS 2 installation, or "
            "pip install 'sst_ros[ros]' (in the source folder: pip install '.[ros]')"
        )
    if module not in EXTRAS:
        return None
    extra = EXTRAS[module]
    return (
        f"{module} is not installed: pip install 'sst_ros[{extra}]' "
        f"(in the source folder: pip install '.[{extra}]')"
    )
