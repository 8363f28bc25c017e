# SPDX-License-Identifier: Apache-2.0
"""Scenes as a caller gives them: a name, a path, a dict; another initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sst_ros.errors import InputError, Problem
from sst_ros.scene.loads import Initial
from sst_ros.scene.scene import Scene, load
from sst_ros.scene.values import plain
from sst_ros.scene.yaml_document import from_values


def scene_of(scene: Scene | Mapping[str, Any] | str | Path) -> Scene:
    """Return a scene as it is, by its name or path, or built from its document as a dict.

    Raises:
        InputError: there is no such scene, or its document is refused.

    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        return from_values(Scene, scene, "scene")
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
