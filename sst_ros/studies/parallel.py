# SPDX-License-Identifier: Apache-2.0
"""The points of a grid evaluated in parallel, one process for each core, in the order given."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from sst_ros.progress import slices

Point = TypeVar("Point")
Result = TypeVar("Result")


def cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def evaluate_grid(
    function: Callable[[Point], Result],
    points: Sequence[Point],
    *,
    workers: int | None = None,
    label: str = "",
    shown: bool = False,
) -> list[Result]:
    """Call a function of a module for each point of a grid.

    A result may depend on its point only, never on the process that computes it: then all bits
    are the same for any number of workers.

    Args:
        function: what to call; each process imports it by its name.
        points: its arguments.
        workers: processes; None for one a core, 1 for this process alone.
        label: label of the progress bar.
        shown: draw a progress bar on a terminal.

    """
    workers = min(workers or cores(), len(points))
    parts = slices(len(points), 1, label, shown)
    if workers <= 1:
        return [function(points[part.start]) for part in parts]
    # Forked processes would share locks of threads that they do not have.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _end_with_the_parent) as executor:
        try:
            results = executor.map(function, points)
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
