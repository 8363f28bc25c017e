# SPDX-License-Identifier: Apache-2.0
"""Scenes from Python values: a dict, other numbers by key, another initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sst_ros.errors import InputError, Problem
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.yaml_document import read


def scene_of(scene: Scene | Mapping[str, Any] | str | Path) -> Scene:
    """Return a scene as it is, by its name or path, or built from its document as a dict.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        return read(Scene, yaml.safe_dump(plain(scene), sort_keys=False), "scene")
    if isinstance(scene, (str, Path)):
        return load(scene)
    allowed = "must be a Scene, the name or path of one, or its document as a dict"
    raise InputError("scene", [Problem("scene", scene, allowed)])


def with_initial(scene: Scene, initial: Any) -> Scene:
    """Return the scene with another initial state: (gamma, gamma_dot), a mapping or `Initial`.

    Raises:
        InputError: it is none of these, or its numbers are refused.

    """
    if initial is None:
        return scene
    if isinstance(initial, Initial):
        return replace(scene, initial=initial)
    names = ("gamma", "gamma_dot", "orientation")
    if isinstance(initial, Mapping):
        unknown = [name for name in initial if name not in names]
        if unknown or "gamma" not in initial:
            allowed = "must have the key gamma, and may have gamma_dot and orientation"
            raise InputError("initial", [Problem("initial", list(initial), allowed)])
        given = dict(initial)
    else:
        try:
            gamma, gamma_dot = initial
        except (TypeError, ValueError):
            allowed = "must be (gamma, gamma_dot), a mapping or Initial"
            raise InputError("initial", [Problem("initial", initial, allowed)]) from None
        given = {"gamma": gamma, "gamma_dot": gamma_dot}
    return replace(scene, initial=Initial(**{name: plain(given[name]) for name in given}))


def plain(value: Any) -> Any:
    """Turn arrays, NumPy numbers, tuples and mappings into what YAML has."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value
