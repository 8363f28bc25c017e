# SPDX-License-Identifier: Apache-2.0
"""`demo`: the main job."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.commands import Commands


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    demo = commands.add_parser("demo", help="run the paper's examples through the nodes")
    demo.add_argument("--out", type=Path, default=Path("demo_out"), help="folder of the results")
    demo.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    from sst_ros.demo import demo

    return demo(options.out)
