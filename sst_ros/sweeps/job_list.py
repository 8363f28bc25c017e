# SPDX-License-Identifier: Apache-2.0
"""Independent jobs in Python, one process for each core; results in the order of the jobs.

Runs that the compiled batch loop cannot do (variable steps, other number types) go here, on Dask's
process scheduler; without Dask one after the other.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, TypeVar

from sst_ros.extras import require
from sst_ros.host.output import slices

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    progress: str = "",
    workers: int | None = None,
) -> list[Result]:
    """Call a function of a module for each job.

    A result may depend on its job only, never on the process that computes it: then all bits are
    the same for any number of workers.

    Args:
        function: what to call; each process imports it by its name.
        jobs: its arguments.
        progress: label of a progress bar on the terminal; empty for none.
        workers: processes; None for one a core, 1 for this process alone.

    """
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    parts = slices(len(jobs), 1, progress, bool(progress))
    if workers <= 1 or importlib.util.find_spec("dask") is None:
        return [function(jobs[part.start]) for part in parts]
    dask = require("dask")
    call = dask.delayed(function, pure=False, traverse=False)
    tasks = [call(dask.delayed(job, traverse=False)) for job in jobs]
    with _bar(parts) if progress else nullcontext():
        results = dask.compute(
            *tasks,
            scheduler="processes",
            num_workers=workers,
            chunksize=1,
            initializer=_end_with_the_parent,
            optimize_graph=False,
        )
        return list(results)


def _bar(parts: Any) -> Any:
    """Return a Dask callback that draws the next part of a bar when a job is done."""
    next(parts, None)
    callback = require("dask.callbacks").Callback
    return callback(posttask=lambda *_: next(parts, None))


def _end_with_the_parent() -> None:
    """End a worker whose parent was killed; nothing else would end it."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
