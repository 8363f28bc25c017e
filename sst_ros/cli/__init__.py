# SPDX-License-Identifier: Apache-2.0
"""The command line, a file per command; each imports what it runs only when it runs."""

from __future__ import annotations

import argparse
from typing import TypeAlias

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def group(parser: argparse.ArgumentParser) -> Commands:
    """Make a command that has commands of its own."""
    return parser.add_subparsers(dest="kind", required=True, metavar="KIND")
