# SPDX-License-Identifier: Apache-2.0
"""Validate a scene file: its document, and the assembly at its initial state.

`scene.load` checks the document only. Every fault is reported with its key and its line.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from sst_ros.errors import InputError, Problem, SstError
from sst_ros.scene.scene import Scene, text_of
from sst_ros.scene.yaml_document import line_of, read
from sst_ros.simulation.simulation import Simulation


def check(name_or_path: str | Path) -> Scene:
    """Read a scene and assemble it at its initial state.

    Raises:
        InputError: it cannot be read, is refused, or cannot start; lists every fault.

    """
    source, origin = text_of(name_or_path)
    scene = read(Scene, source, origin)
    problems: list[Problem]
    try:
        Simulation(scene)
    except InputError as error:
        problems = list(error.problems)
    except SstError as error:
        problems = [Problem("initial.gamma", scene.initial.gamma, f"cannot start here: {error}")]
    else:
        return scene
    placed = [dataclasses.replace(p, line=line_of(source, p.key)) for p in problems]
    raise InputError(origin, placed)
