# SPDX-License-Identifier: Apache-2.0
"""Commands that print a scene: its contents, its faults, its schema, its model as URDF."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from sst_ros.description.urdf import urdf, urdf_with_ros2_control
from sst_ros.errors import InputError, Problem, SstError
from sst_ros.report.scene_summary import summary
from sst_ros.scene.scene import Scene, load, names, text_of
from sst_ros.scene.schema import json_schema
from sst_ros.scene.yaml_document import line_of, read
from sst_ros.simulation.simulation import Simulation

ROUNDING = 1e-6
"""Relative rounding of inertias that a person has typed."""


def list_all(_: argparse.Namespace) -> None:
    """Print the names of the shipped scenes and what they are."""
    for name in names():
        print(f"{name:<18}{load(name).description}")


def show(options: argparse.Namespace) -> None:
    """Print the summary of a scene."""
    print(summary(load(options.scene)), end="")


def check_files(options: argparse.Namespace) -> int:
    """Check files of scenes; print their faults and warnings."""
    failed = 0
    for path in options.files:
        try:
            warnings = implausible(check(path))
            print(f"{path}: valid" + (", with warnings" if warnings else ""))
            for text in warnings:
                print(f"{path}: warning: {text}")
        except SstError as error:
            failed = 1
            print(error)
    return failed


def check(name_or_path: str | Path) -> Scene:
    """Read a scene and assemble it at its initial state, which `load` does not; faults have lines.

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


def print_schema(_: argparse.Namespace) -> None:
    """Print the JSON schema of scenes."""
    print(json.dumps(json_schema(Scene, "sst_ros scene"), indent=2))


def describe(options: argparse.Namespace) -> None:
    """Print a scene as URDF."""
    write = urdf_with_ros2_control if options.ros2_control else urdf
    print(write(load(options.scene)), end="")
