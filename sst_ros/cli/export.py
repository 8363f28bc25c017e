# SPDX-License-Identifier: Apache-2.0
"""`export`: write a recorded run as CSV or Parquet."""

from __future__ import annotations

import argparse
from pathlib import Path

from sst_ros.cli.parsing import Commands, add_out
from sst_ros.output_folder import require_free, results_folder


def add(commands: Commands) -> None:
    """Add the command to the command line."""
    export = commands.add_parser("export", help="write a recorded run as CSV or Parquet")
    export.add_argument("bag", type=Path, metavar="BAG", help="folder of the bag")
    export.add_argument(
        "--format", choices=("csv", "parquet"), default="csv", help="default: csv", dest="form"
    )
    add_out(export, "folder of the tables", "BAG_tables, beside the bag")
    export.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> None:
    out = options.out or results_folder(options.bag, "tables")
    require_free(out, "export", force=options.force)
    from sst_ros.recording.export import export

    for path in export(options.bag, out, options.form, force=options.force):
        print(path)
