# SPDX-License-Identifier: Apache-2.0
"""The command line, a file per command; each imports what it runs only when it runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def group(parser: argparse.ArgumentParser) -> Commands:
    """Make a command that has commands of its own."""
    return parser.add_subparsers(dest="kind", required=True, metavar="KIND")


def add_out(parser: argparse.ArgumentParser, what: str, default: str) -> None:
    """Add `--out` and `--force`; `output_folder.require_free` obeys them."""
    parser.add_argument("--out", type=Path, help=f"{what}; default: {default}")
    parser.add_argument("--force", action="store_true", help="overwrite earlier results in --out")
