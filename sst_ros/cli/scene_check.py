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

ROUNDING = 1e-6
"""Relative rounding of inertias that a person has typed."""


def implausible(scene: Scene) -> list[str]:
    """Describe numbers that no body can have though each alone is allowed.

    A body of mass m within the distance r of O has trace(I) <= 2 m r^2 about O, whatever its shape.
    """
    star = scene.star
    trace, most = float(star.inertia.matrix.trace()), 2.0 * star.mass * star.radius**2
    if star.mass == 0.0 or trace <= most * (1.0 + ROUNDING):
        return []
    return [
        f"star.inertia: its trace is {trace:g} kg m^2; a body of star.mass = {star.mass:g} kg "
        f"within star.radius = {star.radius:g} m has at most 2 m r^2 = {most:g} kg m^2"
    ]


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
