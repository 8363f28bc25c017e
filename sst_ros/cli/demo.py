# SPDX-License-Identifier: Apache-2.0
"""`demo`: the main job."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli import Commands
from sst_ros.control.controller_settings import MODES


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    demo = commands.add_parser("demo", help="run the paper's examples, or a motion, by the nodes")
    demo.add_argument(
        "kind",
        nargs="?",
        choices=("examples", "feedforward"),
        default="examples",
        help="the paper's examples, or the companion that follows a scene's motion",
    )
    demo.add_argument("--out", type=Path, help="folder of the results; default: demo_out")
    demo.add_argument("--scene", help="with feedforward: name, or path of a .yaml file")
    demo.add_argument("--mode", nargs="+", choices=MODES, help="with feedforward: controllers")
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    from sst_ros import demo

    out = options.out or Path("demo_out")
    if options.kind == "examples":
        return demo.demo(out)
    where = options.out or out / "feedforward"
    return demo.feedforward(where, options.scene or demo.FOLLOWED, options.mode or demo.MODES)
