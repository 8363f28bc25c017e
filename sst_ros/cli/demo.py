# SPDX-License-Identifier: Apache-2.0
"""`demo`: the main job by the nodes."""

from __future__ import annotations

import argparse

from sst_ros.cli.parsing import Commands, add_out, add_scene_name, command, free_out, refuse
from sst_ros.errors import InputError, Problem, suggestion
from sst_ros.extras import require

NEEDED = ("rclpy", "rosbags", "matplotlib")
"""Optional modules; the nodes, which need the first two, are processes of their own."""


def add_demo(commands: Commands) -> None:
    """Add `demo` to the command line."""
    what = "run the paper's examples or a reference motion by the nodes"
    demo = command(commands, "demo", _demo, what)
    demo.add_argument(
        "kind",
        nargs="?",
        choices=("examples", "feedforward"),
        default="examples",
        help="the paper's examples; or the node inverse_dynamics following a scene's motion",
    )
    add_out(demo, "folder of the results", "demo_out or demo_out/feedforward")
    add_scene_name(
        demo, "--scene", help="with feedforward: name of a scene, or path of a .yaml file"
    )
    demo.add_argument("--mode", nargs="+", metavar="MODE", help="with feedforward: control modes")


def _demo(options: argparse.Namespace) -> int:
    if options.kind != "feedforward":
        given = {"--scene": options.scene, "--mode": options.mode}
        allowed = "is an option of `demo feedforward`"
        if wrong := [Problem(key, value, allowed) for key, value in given.items() if value]:
            raise InputError("demo", wrong)
    from sst_ros.control.controller import MODES

    for mode in options.mode or ():
        if mode not in MODES:
            allowed = f"must be one of {', '.join(MODES)}{suggestion(mode, MODES)}"
            refuse(options, "--mode", mode, allowed)
    out = free_out(
        options, "demo_out" if options.kind == "examples" else f"demo_out/{options.kind}"
    )
    for module in NEEDED:
        require(module)
    from sst_ros import demo

    if options.kind == "examples":
        return demo.demo(out)
    return demo.feedforward(out, options.scene or demo.FOLLOWED, options.mode or demo.MODES)
