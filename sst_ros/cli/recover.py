# SPDX-License-Identifier: Apache-2.0
"""`recover`: save what a killed recorder has written."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli import Commands


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    recovery = commands.add_parser("recover", help="save what a killed recorder has written")
    recovery.add_argument("bag", type=Path, help="folder of the bag")
    recovery.add_argument("--out", type=Path, help="folder of the new bag; default: beside the old")
    recovery.set_defaults(run=_recover)


def _recover(options: argparse.Namespace) -> None:
    from sst_ros.recording.recovery import recover

    bag, messages, cut = recover(options.bag, options.out)
    said = ", the recording is cut off" if cut else ""
    print(f"{messages} messages recovered into {bag}{said}")
