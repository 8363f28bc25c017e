# SPDX-License-Identifier: Apache-2.0
"""`recover`: a whole recording of what is intact in a cut or damaged one."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    recovery = commands.add_parser(
        "recover", help="write a valid recording from a truncated or damaged one"
    )
    recovery.add_argument("bag", type=Path, help="folder of the bag")
    recovery.add_argument("--out", type=Path, help="folder of the new bag; default: beside the old")
    recovery.set_defaults(run=_recover)


def _recover(options: argparse.Namespace) -> None:
    from sst_ros.recording.recovery import recover

    found = recover(options.bag, options.out)
    print(f"{found.messages} messages recovered into {found.bag}, {found.lost} known to be lost")
    for line in found.damage:
        print(f"  {line}")
