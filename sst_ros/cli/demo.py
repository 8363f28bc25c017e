# SPDX-License-Identifier: Apache-2.0
"""`demo`, `paper`: the main job by the nodes, and the paper's Figs. 8 to 14 from scratch."""

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
        choices=("examples", "feedforward", "identify"),
        default="examples",
        help="the paper's examples; the node inverse_dynamics following a scene's motion; or a "
        "model identified from a recorded motion, and the tracking error before and after",
    )
    add_out(demo, "folder of the results", "demo_out, demo_out/feedforward or demo_out/identify")
    add_scene_name(
        demo, "--scene", help="with feedforward: name of a scene, or path of a .yaml file"
    )
    demo.add_argument("--mode", nargs="+", metavar="MODE", help="with feedforward: control modes")


def add_paper(commands: Commands) -> None:
    """Add `paper` to the command line."""
    what = "draw Figs. 8 to 14 of the paper: nodes, continuous solution, Pinocchio"
    paper = command(commands, "paper", _paper, what)
    add_out(paper, "folder of the pictures and their index page", "paper_out")


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
            refuse(options, "--mode", mode, allowed)
    out = free_out(
        options, "demo_out" if options.kind == "examples" else f"demo_out/{options.kind}"
    )
    for module in NEEDED:
        require(module)
    from sst_ros import demo

    if options.kind == "examples":
        return demo.demo(out)
    if options.kind == "identify":
        from sst_ros.identification_demo import identification

        return identification(out)
    return demo.feedforward(out, options.scene or demo.FOLLOWED, options.mode or demo.MODES)


def _paper(options: argparse.Namespace) -> int:
    out = free_out(options, "paper_out")
    for module in NEEDED:
        require(module)
    from sst_ros.paper import paper

    return 0 if all(each.within for each in paper(out)) else 1
