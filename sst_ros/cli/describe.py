# SPDX-License-Identifier: Apache-2.0
"""`describe`: a scene as URDF."""

from __future__ import annotations

import argparse

from sst_ros import scene
from sst_ros.cli import Commands


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    describe = commands.add_parser("describe", help="write a scene as URDF")
    describe.add_argument(
        "--scene", default="example2", metavar="S", help="name, or path of a .yaml file"
    )
    describe.set_defaults(run=_describe)


def _describe(options: argparse.Namespace) -> None:
    from sst_ros.description.urdf import urdf

    print(urdf(scene.load(options.scene)), end="")
