# SPDX-License-Identifier: Apache-2.0
"""`scene`, `describe`, `compile`, `workspace`: what a scene is, without a run of it."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

from sst_ros.cli.parsing import Commands, add_out, add_scene_name, command, free_out, group, refuse
from sst_ros.errors import InputError, Problem, SstError, suggestion
from sst_ros.extras import require

if TYPE_CHECKING:
    from sst_ros.scene.scene import Scene

FORMATS = (".png", ".pdf", ".svg")

ROUNDING = 1e-6
"""Relative rounding of inertias that a person has typed."""


def add_scene(commands: Commands) -> None:
    """Add `scene` to the command line."""
    kinds = group(commands, "scene", "list, show and check scenes")
    command(kinds, "list", _list, "list the shipped scenes")
    show = command(kinds, "show", _show, "show contents, cost of a step and advice on the method")
    add_scene_name(show, "scene", metavar="SCENE")
    check = command(kinds, "check", _check, "check scene files and report all faults")
    check.add_argument("files", nargs="+", type=Path, metavar="FILE")
    command(kinds, "schema", _schema, "print the JSON schema, for editors")


def add_describe(commands: Commands) -> None:
    """Add `describe` to the command line."""
    describe = command(commands, "describe", _describe, "write a scene as URDF")
    add_scene_name(describe, "--scene", default="example2", metavar="S")
    describe.add_argument(
        "--ros2-control", action="store_true",
        help="with the tag by which ros2_control drives the actuators of a running simulator",
    )  # fmt: skip


def add_compile(commands: Commands) -> None:
    """Add `compile` to the command line."""
    compile_ = command(commands, "compile", _compile, "compile a scene before its first fast run")
    add_scene_name(compile_, "scene", nargs="?", default="example2", metavar="SCENE")
    compile_.add_argument(
        "--integrator", default="auto", help="auto, or the name of an integrator; default: auto"
    )


def add_workspace(commands: Commands) -> None:
    """Add `workspace` to the command line."""
    what = "map the workspace of a scene: reach, condition, singular poses"
    workspace = command(commands, "workspace", _workspace, what)
    add_scene_name(workspace, "scene", metavar="SCENE")
    add_out(workspace, "picture, .png, .pdf or .svg", "SCENE_workspace.png")


def _list(_: argparse.Namespace) -> None:
    from sst_ros.scene.scene import load, names

    for name in names():
        print(f"{name:<18}{load(name).description}")


def _show(options: argparse.Namespace) -> None:
    from sst_ros.report.scene_summary import summary
    from sst_ros.scene.scene import load

    print(summary(load(options.scene)), end="")


def _check(options: argparse.Namespace) -> int:
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


def _schema(_: argparse.Namespace) -> None:
    from sst_ros.scene.scene import Scene
    from sst_ros.scene.schema import json_schema

    print(json.dumps(json_schema(Scene, "sst_ros scene"), indent=2))


def _describe(options: argparse.Namespace) -> None:
    from sst_ros.description.urdf import urdf, urdf_with_ros2_control
    from sst_ros.scene.scene import load

    write = urdf_with_ros2_control if options.ros2_control else urdf
    print(write(load(options.scene)), end="")


def _compile(options: argparse.Namespace) -> None:
    from sst_ros.host.cache_folder import cache_folder, configured_folder
    from sst_ros.integration import code_cache, codegen
    from sst_ros.scene.scene import load
    from sst_ros.simulation.simulation import INTEGRATORS

    if options.integrator not in INTEGRATORS:
        allowed = f"must be one of {', '.join(INTEGRATORS)}"
        allowed += suggestion(options.integrator, INTEGRATORS)
        refuse(options, "--integrator", options.integrator, allowed)
    if codegen.numba_version() is None:
        require("numba")
        raise SstError("numba is switched off by SST_ROS_NUMBA=0")
    if (folder := cache_folder()) != configured_folder():
        raise SstError("compiled code would not be kept; see the warning above")
    simulated = load(options.scene)
    for method in code_cache.make(simulated, options.integrator):
        print(f"{method}: compiled, in {folder}", flush=True)
    if not code_cache.is_there(simulated, options.integrator):
        raise SstError("another process is compiling: try again when it has ended")


def _workspace(options: argparse.Namespace) -> None:
    from sst_ros.mechanism import workspace
    from sst_ros.mechanism.geometry import Geometry
    from sst_ros.scene.scene import load

    scene = load(options.scene)
    out = options.out or Path(f"{Path(options.scene).stem}_workspace.png")
    if out.suffix not in FORMATS:
        refuse(options, "--out", str(out), f"must end in {' or '.join(FORMATS)}")
    free_out(options, out)
    require("matplotlib")
    from sst_ros.plot.style import save_figure
    from sst_ros.plot.workspace import plot_workspace

    geometry = Geometry.of(scene)
    directions, _ = workspace.triangle_directions(geometry, divisions=60)
    chart = workspace.over_orientations(geometry, directions, turns=180, progress=True)
    print(workspace.report_singularities(geometry, chart))
    save_figure(plot_workspace(chart, titles=[scene.name]), out)
    print(out)


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
    """Read a scene and assemble it at its initial state, which `load` does not; faults have lines.

    Raises:
        InputError: it cannot be read, is refused, or cannot start; lists every fault.

    """
    from sst_ros.scene.scene import Scene, text_of
    from sst_ros.scene.yaml_document import line_of, read
    from sst_ros.simulation.simulation import Simulation

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
