# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study on this machine: a Dask graph on threads, without a server process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from sst_ros.errors import SstError
from sst_ros.extras import require
from sst_ros.sweeps.chunk_task import DONE, ChunkOutcome, ChunkTask, run_chunk


class SweepFailed(SstError):
    """Chunks of a study could not be computed or written; the others are complete."""


def run_local(
    task: ChunkTask, chunks: Sequence[int], done: Callable[[ChunkOutcome], None], workers: int
) -> None:
    """Compute chunks on threads; the compiled code releases the interpreter's lock.

    Args:
        task: what all chunks have in common.
        chunks: indices of the chunks.
        done: is called with each outcome, one at a time.
        workers: number of threads; 1 for Dask's synchronous scheduler.

    Raises:
        SweepFailed: a file cannot be written.

    """
    dask = require("dask")
    lock, failed = threading.Lock(), threading.Event()

    def run(index: int) -> None:
        if failed.is_set():
            return
        try:
            outcome = run_chunk(task, index)
        except BaseException:
            failed.set()
            raise
        if outcome.status != DONE:
            failed.set()
            raise SweepFailed(f"chunk {index}: {outcome.detail}")
        with lock:
            done(outcome)

    # By its name Dask would look for a client first, and import all of distributed.
    get = require("dask.threaded").get if workers > 1 else require("dask.local").get_sync
    tasks = [dask.delayed(run, pure=False)(index) for index in chunks]
    dask.compute(*tasks, scheduler=get, num_workers=workers)
