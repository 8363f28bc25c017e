# SPDX-License-Identifier: Apache-2.0
"""Grids of runs behind pages of docs/, each by `python -m studies.NAME`; not installed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from sst_ros.errors import SstError

DOCS = Path(__file__).parents[1] / "docs"


def parser(name: str, description: str, out: Path) -> argparse.ArgumentParser:
    """Make the parser of a study's arguments, with the folder of its results."""
    made = argparse.ArgumentParser(prog=f"python -m studies.{name}", description=description)
    made.add_argument(
        "--out", type=Path, default=out, help=f"folder of the results; default: {out}"
    )
    return made


def run(
    study: Callable[[argparse.Namespace], bool],
    arguments: argparse.ArgumentParser,
    words: Sequence[str] | None,
) -> int:
    """Run a study; return the exit status: 1, too, where its results are not as they should be."""
    try:
        return 0 if study(arguments.parse_args(words)) else 1
    except SstError as error:
        print(f"{arguments.prog}: {error}", file=sys.stderr)
        return 1
