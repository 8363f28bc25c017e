# SPDX-License-Identifier: Apache-2.0
"""Independent jobs in parallel, one process for each core; results in the order of the jobs."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from sst_ros.progress import slices

Job = TypeVar("Job")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


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
    workers = min(workers or cores(), len(jobs))
    parts = slices(len(jobs), 1, progress, bool(progress))
    if workers <= 1:
        return [function(jobs[part.start]) for part in parts]
    # Forked processes would share locks of threads that they do not have.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _end_with_the_parent) as executor:
        try:
            results = executor.map(function, jobs)
            return [next(results) for _ in parts]
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_the_parent() -> None:
    """End a worker whose parent was killed; nothing else would end it."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
