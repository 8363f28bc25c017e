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
    """Import an optional dependency; MissingDependency says how to install it."""
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
    ros = module in _ROS or module.endswith(_ROS_SUFFIXES)
    if not ros and module not in EXTRAS:
        return None
    extra = "ros" if ros else EXTRAS[module]
    how = f"pip install 'sst_ros[{extra}]' (in the source folder: pip install '.[{extra}]')"
    return f"{module} is not installed: {'source a ROS 2 installation, or ' * ros}{how}"
