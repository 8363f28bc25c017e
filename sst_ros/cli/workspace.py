# SPDX-License-Identifier: Apache-2.0
"""`workspace`: where E can be, how far the star can turn there, and how well it is held."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out, add_scene
from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import require_free

FORMATS = (".png", ".pdf", ".svg")


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    workspace = commands.add_parser(
        "workspace", help="map the workspace of a scene: reach, condition, singular poses"
    )
    add_scene(workspace, "scene", metavar="SCENE")
    add_out(workspace, "picture, .png, .pdf or .svg", "SCENE_workspace.png")
    workspace.set_defaults(run=_workspace)


def _workspace(options: argparse.Namespace) -> None:
    from sst_ros.extras import require
    from sst_ros.mechanism import singularities, workspace
    from sst_ros.mechanism.geometry import Geometry
    from sst_ros.scene.scene import load

    scene = load(options.scene)
    out = options.out or Path(f"{Path(options.scene).stem}_workspace.png")
    if out.suffix not in FORMATS:
        raise InputError(
            "workspace", [Problem("--out", str(out), f"must end in {' or '.join(FORMATS)}")]
        )
    require_free(out, "workspace", force=options.force)
    require("matplotlib")
    from sst_ros.plot.style import save_figure
    from sst_ros.plot.workspace import draw

    geometry = Geometry.of(scene)
    directions, faces = workspace.triangle_directions(geometry, divisions=60)
    chart = workspace.over_orientations(geometry, directions, turns=180, progress=True)
    print(singularities.report(geometry, chart))
    save_figure(draw([chart], [faces], [scene.name]), out)
    print(out)
