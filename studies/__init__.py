# SPDX-License-Identifier: Apache-2.0
"""Grids of runs behind pages of docs/, each by `python -m studies.NAME`.

Not installed.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from sst_ros.errors import SstError, require
from sst_ros.files import require_free
from sst_ros.integration.many_runs import run_many
from sst_ros.progress import follow
from sst_ros.sweeps.cluster import run_on_cluster

DOCS = Path(__file__).parents[1] / "docs"
PAGES = Path(__file__).parent / "pages"

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

    The study gets the options, with the folder `out`, and says whether its results are
    as they should be. A careful one does not overwrite earlier results without
    `--force`. Further `options` are what `add_argument` takes, by name.
    """
    about = (sys.modules[study.__module__].__doc__ or "").partition("\n")[0]
    parser = argparse.ArgumentParser(
        prog=f"python -m studies.{name}", description=about
    )
    parser.add_argument(
        "--out", type=Path, default=out, help=f"folder of the results; {out}"
    )
    if careful:
        parser.add_argument(
            "--force", action="store_true", help="overwrite earlier results"
        )
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
    label: str = "",
    workers: int = 0,
) -> list[Result]:
    """Call a function of a module for each job.

    Return the results in the order of the jobs.

    They are called in processes of this machine, by default one a core, or in this one
    for 1 worker; a bar with the label is drawn. A result may depend on its job only:
    then all bits are the same for any number of workers.
    """
    if workers == 1:
        numbered = run_many(function, jobs, label=label)
    else:
        client = _processes(workers or len(os.sched_getaffinity(0)))
        numbered = follow(run_on_cluster(client, function, jobs), len(jobs), label)
    results = dict(numbered)
    return [results[number] for number in range(len(jobs))]


@cache
def _processes(count: int) -> Any:
    """Return a client of processes that end with this one."""
    given = {"n_workers": count, "threads_per_worker": 1, "dashboard_address": ":0"}
    return require("distributed").Client(**given, set_as_default=False)
