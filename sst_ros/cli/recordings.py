# SPDX-License-Identifier: Apache-2.0
"""Commands on recordings that compute nothing: tables of one, a valid one of a damaged one."""

from __future__ import annotations

import argparse

from sst_ros.cli.commands import free_out
from sst_ros.host.output import results_folder
from sst_ros.recording.bag_writer import recover
from sst_ros.recording.recording import export


def write_tables(options: argparse.Namespace) -> None:
    """Write the tables of a recorded run."""
    out = free_out(options, results_folder(options.bag, "tables"))
    for path in export(options.bag, out, options.format, force=options.force):
        print(path)


def write_recovered(options: argparse.Namespace) -> None:
    """Write what is intact in a recording as a new one."""
    found = recover(options.bag, options.out)
    print(f"{found.messages} messages recovered into {found.bag}, {found.lost} known to be lost")
    for line in found.damage:
        print(f"  {line}")
