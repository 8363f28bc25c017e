# SPDX-License-Identifier: Apache-2.0
"""`demo`: the main job."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out, add_scene
from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.extras import require
from sst_ros.output_folder import require_free


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    demo = commands.add_parser(
        "demo", help="run the paper's examples or a reference motion by the nodes"
    )
    demo.add_argument(
        "kind",
        nargs="?",
        choices=("examples", "feedforward", "identify"),
        default="examples",
        help="the paper's examples; the node inverse_dynamics following a scene's motion; or a "
        "model identified from a recorded motion, and the tracking error before and after",
    )
    add_out(demo, "folder of the results", "demo_out, demo_out/feedforward or demo_out/identify")
    add_scene(demo, "--scene", help="with feedforward: name of a scene, or path of a .yaml file")
    demo.add_argument("--mode", nargs="+", metavar="MODE", help="with feedforward: control modes")
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    if options.kind != "feedforward":
        given = {"--scene": options.scene, "--mode": options.mode}
        allowed = "is an option of `demo feedforward`"
        if wrong := [Problem(key, value, allowed) for key, value in given.items() if value]:
            raise InputError("demo", wrong)
    from sst_ros.control.controller_settings import MODES

    for mode in options.mode or ():
        if mode not in MODES:
            allowed = f"must be one of {', '.join(MODES)}{suggestion(mode, MODES)}"
            raise InputError("demo", [Problem("--mode", mode, allowed)])
    default = "demo_out" if options.kind == "examples" else f"demo_out/{options.kind}"
    out = require_free(options.out or Path(default), "demo", force=options.force)
    for module in ("rclpy", "rosbags", "matplotlib"):
        require(module)  # the nodes, which need the first two, are processes of their own
    from sst_ros import demo

    if options.kind == "examples":
        return demo.demo(out)
    if options.kind == "identify":
        from sst_ros.identification_demo import identification

        return identification(out)
    return demo.feedforward(out, options.scene or demo.FOLLOWED, options.mode or demo.MODES)
