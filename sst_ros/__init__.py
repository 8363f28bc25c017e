# SPDX-License-Identifier: Apache-2.0
"""Simulator of the 3-RRP spherical star-triangle parallel manipulator."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sst_ros.scene.scene import Scene
    from sst_ros.scene.scene import load as load_scene
    from sst_ros.simulation import Simulation

__version__ = "0.1.0"
__all__ = ["Scene", "Simulation", "__version__", "load_scene"]

# Imported at first use: the command line and the nodes must not wait for what they do not need.
_WHERE = {
    "Scene": ("sst_ros.scene.scene", "Scene"),
    "Simulation": ("sst_ros.simulation", "Simulation"),
    "load_scene": ("sst_ros.scene.scene", "load"),
}


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _WHERE[name]
    value: object = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
