# SPDX-License-Identifier: Apache-2.0
"""Many runs at once, one process for each core; answers come in the order of the questions."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from sst_ros.progress import slices

Question = TypeVar("Question")
Answer = TypeVar("Answer")


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def answers(
    function: Callable[[Question], Answer],
    questions: Sequence[Question],
    *,
    workers: int | None = None,
    label: str = "",
    shown: bool = False,
) -> list[Answer]:
    """Call a function of a module for each question.

    An answer may depend on its question only, never on the process that gives it: then all bits
    are the same for any number of workers.

    Args:
        function: what to call; found by its name in each process.
        questions: its arguments.
        workers: processes; none for one a core, 1 for this one alone.
        label: what the bar says.
        shown: draw a bar on a terminal.

    """
    workers = min(workers or cores(), len(questions))
    parts = slices(len(questions), 1, label, shown)
    if workers <= 1:
        return [function(questions[part.start]) for part in parts]
    # Forked processes would share locks of threads that they do not have.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _end_with_the_parent) as pool:
        try:
            coming = pool.map(function, questions)
            return [next(coming) for _ in parts]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_the_parent() -> None:
    """End a worker whose parent was killed: nobody tells it, and it would wait for ever."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
