# SPDX-License-Identifier: Apache-2.0
"""Grids of runs behind pages of docs/, each by `python -m studies.NAME`; not installed."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from sst_ros.errors import SstError
from sst_ros.host.output import require_free, slices

DOCS = Path(__file__).parents[1] / "docs"

Job = TypeVar("Job")
Result = TypeVar("Result")


def run(
    study: Callable[[argparse.Namespace], bool],
    name: str,
    out: Path,
    words: Sequence[str] | None,
    *,
    careful: bool = False,
    **options: dict[str, Any],
) -> int:
    """Run a study from the command line; return the exit status.

    The study gets the options, with the folder `out`, and says whether its results are as they
    should be. A careful one does not overwrite earlier results without `--force`. Further `options`
    are what `add_argument` takes, by name.
    """
    about = (sys.modules[study.__module__].__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(prog=f"python -m studies.{name}", description=about)
    parser.add_argument("--out", type=Path, default=out, help=f"folder of the results; {out}")
    if careful:
        parser.add_argument("--force", action="store_true", help="overwrite earlier results")
    for option, given in options.items():
        parser.add_argument(f"--{option}", **given)
    found = parser.parse_args(words)
    try:
        if careful:
            require_free(found.out, parser.prog, force=found.force)
        return 0 if study(found) else 1
    except SstError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    progress: str = "",
    workers: int | None = None,
) -> list[Result]:
    """Call a function of a module for each job; return the results in the order of the jobs.

    A result may depend on its job only: then all bits are the same for any number of workers.

    Args:
        function: what to call; each process imports it by its name.
        jobs: its arguments.
        progress: label of a bar on the terminal; empty for none.
        workers: processes; None for one a core, 1 for this process alone.

    """
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    bar = slices(len(jobs), 1, progress, bool(progress))
    if workers <= 1:
        return [function(jobs[part.start]) for part in bar]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _end_with_the_parent) as pool:
        return [result for _, result in zip(bar, pool.map(function, jobs), strict=True)]


def _end_with_the_parent() -> None:
    """End a worker whose parent was killed; nothing else would end it."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
