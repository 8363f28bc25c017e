# SPDX-License-Identifier: Apache-2.0
"""`describe`: a scene as URDF."""

from __future__ import annotations

import argparse

from sst_ros.cli.parsing import Commands, add_scene


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    describe = commands.add_parser("describe", help="write a scene as URDF")
    add_scene(describe, "--scene", default="example2", metavar="S")
    describe.add_argument(
        "--ros2-control", action="store_true",
        help="with the tag by which ros2_control drives the actuators of a running simulator",
    )  # fmt: skip
    describe.set_defaults(run=_describe)


def _describe(options: argparse.Namespace) -> None:
    from sst_ros.description.ros2_control import urdf_with_ros2_control
    from sst_ros.description.urdf import urdf
    from sst_ros.scene.scene import load

    write = urdf_with_ros2_control if options.ros2_control else urdf
    print(write(load(options.scene)), end="")
