# SPDX-License-Identifier: Apache-2.0
"""`paper`: the paper's Figs. 8 to 14 from scratch."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out
from sst_ros.extras import require
from sst_ros.output_folder import require_free


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    paper = commands.add_parser(
        "paper", help="draw Figs. 8 to 14 of the paper: nodes, continuous solution, Pinocchio"
    )
    add_out(paper, "folder of the pictures and their index page", "paper_out")
    paper.set_defaults(run=_paper)


def _paper(options: argparse.Namespace) -> int:
    out = require_free(options.out or Path("paper_out"), "paper", force=options.force)
    for module in ("rclpy", "rosbags", "matplotlib"):
        require(module)
    from sst_ros.paper import paper

    return 0 if all(each.within for each in paper(out)) else 1
