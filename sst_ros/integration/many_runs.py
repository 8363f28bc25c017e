# SPDX-License-Identifier: Apache-2.0
"""Many runs of one function, in this thread or on several threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

from sst_ros.progress import follow

Job = TypeVar("Job")
Result = TypeVar("Result")
_OWN = threading.local()
"""What belongs to a thread of a pool: `stop`, set when its results are not wanted."""


def run_many(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    label: str = "",
) -> Iterator[tuple[int, Result]]:
    """Call a function for each job; yield the job's number and result when it is done.

    Args:
        function: what is called; an exception that it raises ends all jobs.
        jobs: its arguments.
        workers: threads of this process, 0 for one a core; 1 for none, in the order of
            the jobs.
        label: of a bar that is drawn on a terminal; none is drawn without it.

    """
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    results: Iterator[tuple[int, Result]]
    if workers > 1:
        results = _on_threads(function, jobs, workers)
    else:
        results = ((number, function(job)) for number, job in enumerate(jobs))
    yield from follow(results, len(jobs), label)


def _on_threads(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[int, Result]]:
    stop = threading.Event()

    def begin_thread() -> None:
        _OWN.stop = stop

    pool = ThreadPoolExecutor(workers, initializer=begin_thread)
    futures = {pool.submit(function, job): number for number, job in enumerate(jobs)}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        stop.set()  # what still runs is of no use
        pool.shutdown(cancel_futures=True)


class Stopped(BaseException):
    """The results of a job are no longer wanted: its run ends at once."""


def stop_if_asked() -> None:
    """Raise Stopped in a thread of `run_many` whose results are no longer wanted.

    In other threads it does nothing. Long jobs call it now and then, so that an
    interrupt of the main thread, or an error in another job, ends them at once.
    """
    stop = getattr(_OWN, "stop", None)
    if stop is not None and stop.is_set():
        raise Stopped
