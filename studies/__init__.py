# SPDX-License-Identifier: Apache-2.0
"""Grids of runs behind pages of docs/, each by `python -m studies.NAME`; not installed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from sst_ros.errors import SstError
from sst_ros.host.output import require_free

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
    *,
    careful: bool = False,
) -> int:
    """Run a study; return the exit status: 1, too, where its results are not as they should be.

    A careful one refuses to overwrite earlier results without `--force`.
    """
    if careful:
        arguments.add_argument("--force", action="store_true", help="overwrite earlier results")
    options = arguments.parse_args(words)
    try:
        if careful:
            require_free(options.out, arguments.prog, force=options.force)
        return 0 if study(options) else 1
    except SstError as error:
        print(f"{arguments.prog}: {error}", file=sys.stderr)
        return 1
