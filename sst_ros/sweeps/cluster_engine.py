# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study on a Dask cluster; workers may join, die, and run out of disk.

A chunk is a task of its own, so a killed worker costs the chunks that it was computing. A worker
that refuses a chunk (another version, no space left) gets no more of them. A chunk that ends its
worker again and again is given up when all others are done. Every wait has a bound.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from sst_ros.errors import InputError, Problem, SstError
from sst_ros.extras import require
from sst_ros.host.cache_folder import cache_folder, store
from sst_ros.sweeps.chunk_task import ChunkOutcome, ChunkTask, SweepFailed, run_chunk

NO_WORKER, NO_SCHEDULER = 60.0, 15.0
"""Longest wait for a worker that takes chunks, and for a scheduler that does not answer [s]."""

GATHER = 10.0
"""Longest wait for the outcome of a chunk that is done [s]."""

NO_ANSWER = "the scheduler does not answer; continue with --resume"

MOST_DEATHS = 5
"""Attempts at a chunk whose workers die; Dask itself makes three of each."""

AHEAD = 4
"""Chunks sent to the scheduler for each thread: enough to keep it busy, few enough to cancel."""


def connect(address: str) -> Any:
    """Return a client of the scheduler at an address.

    Raises:
        InputError: no scheduler answers there.

    """
    distributed = require("distributed")
    try:
        return distributed.Client(address, timeout=NO_SCHEDULER, set_as_default=False)
    except (OSError, ValueError) as error:
        allowed = f"must be the address of a Dask scheduler, as tcp://host:8786 ({error})"
        raise InputError("sweep", [Problem("--scheduler", address, allowed)]) from None


def send_code(client: Any, modules: Sequence[Any]) -> None:
    """Send compiled code to each worker once, also to those that join later.

    A file's name is the digest of its source and of all versions, so a worker of another kind
    finds none of its own and compiles.
    """
    plugin = require("distributed").WorkerPlugin
    folder, files = cache_folder(), {}
    paths = [Path(getattr(module, "__file__", None) or "") for module in modules]
    for path in paths:
        if path.parent == folder:
            for file in (path, *(folder / "__pycache__").glob(f"{path.stem}.*.nb[ic]")):
                files[str(file.relative_to(folder))] = file.read_bytes()

    class SentCode(plugin):  # type: ignore[misc,valid-type]
        """Writes the files where they are missing."""

        def setup(self, worker: Any) -> None:
            store(files)

    client.register_plugin(SentCode(), name="-".join(["sst_ros", *(path.stem for path in paths)]))


def run_on_cluster(
    client: Any,
    task: ChunkTask,
    chunks: Sequence[int],
    done: Callable[[ChunkOutcome], None],
) -> None:
    """Compute chunks on the workers of a client; print what it finds out about them.

    Args:
        client: of a Dask cluster.
        task: what all chunks have in common.
        chunks: indices of the chunks.
        done: is called with each outcome that is done.

    Raises:
        SweepFailed: chunks are not done: no worker takes them, they end their workers, or the
            scheduler is gone. All others are.

    """
    with client.as_current():
        _Run(client, task, done).run(list(chunks))


class _Run:
    def __init__(self, client: Any, task: ChunkTask, done: Any) -> None:
        self._distributed = require("distributed")
        self._closed = require("distributed.comm").CommClosedError
        # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
        self._waits = TimeoutError, self._distributed.TimeoutError, self._distributed.CancelledError
        self._client, self._task, self._done = client, task, done
        self._refused: dict[str, str] = {}
        self._running: dict[Any, tuple[int, list[str] | None]] = {}
        self._deaths: Counter[int] = Counter()
        self._given_up: dict[int, str] = {}

    def run(self, waiting: list[int]) -> None:
        waiting.reverse()
        try:
            self._refuse_other_versions()
            self._run(waiting)
        except (self._closed, *self._waits) as error:
            raise SweepFailed(f"{NO_ANSWER} ({error})") from error
        finally:
            if self._client.status == "running":
                self._client.cancel(list(self._running), force=True)
        if self._given_up:
            texts = [f"chunk {index}: {text}" for index, text in sorted(self._given_up.items())]
            raise SweepFailed("; ".join(texts))

    def _run(self, waiting: list[int]) -> None:
        idle = time.monotonic()
        while waiting or self._running:
            threads = self._threads()
            if threads:
                idle = time.monotonic()
            elif time.monotonic() - idle > NO_WORKER:
                refused = "; ".join(f"{worker}: {text}" for worker, text in self._refused.items())
                why = f"{NO_WORKER:g} s ({refused or 'none is there'})"
                raise SweepFailed(f"no worker takes chunks for {why}")
            waiting += self._take_back_stranded(threads.keys())
            room = AHEAD * sum(threads.values()) - len(self._running)
            for _ in range(min(room, len(waiting))):
                self._submit(waiting.pop(), list(threads) if self._refused else None)
            waiting += self._collect()

    def _threads(self) -> dict[str, int]:
        """Threads of each worker that takes chunks."""
        end = time.monotonic() + NO_SCHEDULER
        while self._client.status != "running":
            if self._client.status == "closed" or time.monotonic() > end:
                raise SweepFailed(NO_ANSWER)
            time.sleep(0.1)
        workers = self._client.scheduler_info(n_workers=-1)["workers"].items()
        return {name: about["nthreads"] for name, about in workers if name not in self._refused}

    def _submit(self, index: int, workers: list[str] | None) -> None:
        """Send a chunk to any worker, or to one of these."""
        key = f"chunk-{index}-{time.monotonic_ns()}"
        future = self._client.submit(
            _run_on_worker, self._task, index, pure=False, workers=workers, key=key
        )
        self._running[future] = index, workers

    def _take_back_stranded(self, workers: Collection[str]) -> list[int]:
        """Take back chunks whose chosen workers are all gone: Dask would wait for those."""
        stranded = [
            future
            for future, (_, chosen) in self._running.items()
            if chosen and not set(workers).intersection(chosen) and future.status == "pending"
        ]
        if stranded:
            self._client.cancel(stranded, force=True)
        return [self._running.pop(future)[0] for future in stranded]

    def _collect(self) -> list[int]:
        """Take what has ended; return the chunks to be computed again."""
        if not self._running:
            time.sleep(0.2)
            return []
        with contextlib.suppress(*self._waits):
            self._distributed.wait(list(self._running), timeout=1.0, return_when="FIRST_COMPLETED")
        again = []
        for future in [one for one in self._running if one.status != "pending"]:
            index, _ = self._running.pop(future)
            taken = False
            with contextlib.suppress(*self._waits):  # the worker that held the outcome is gone
                taken = self._take(index, future)
            future.release()
            if not taken:
                again.append(index)
        return again

    def _take(self, index: int, future: Any) -> bool:
        """Take what a chunk has come to; return False if it has to be computed again."""
        if future.status == "finished":
            outcome = future.result(timeout=GATHER)
            if outcome.fault:
                self._refuse(outcome.worker, outcome.fault)
                return False
            self._done(outcome)
            return True
        if future.status != "error":
            return False
        error = future.exception(timeout=GATHER)
        if isinstance(error, self._distributed.KilledWorker):
            self._deaths[index] += 1
            if self._deaths[index] < MOST_DEATHS:
                return False
            self._given_up[index] = f"its workers died {MOST_DEATHS} times ({error})"
        else:
            name = "" if isinstance(error, SstError) else f"{type(error).__name__}: "
            self._given_up[index] = f"{name}{error}"
        return True

    def _refuse_other_versions(self) -> None:
        """Refuse the workers that have other versions, before they have to read a study."""
        code = (
            f"__import__('sst_ros.sweeps.chunk_task', fromlist=['difference'])"
            f".difference({self._task.versions!r})"
        )
        for worker, answer in self._client.run(eval, code, on_error="return").items():
            if answer != "":
                text = f"this worker has {answer}" if isinstance(answer, str) else f"{answer!r}"
                self._refuse(worker, text)

    def _refuse(self, worker: str, detail: str) -> None:
        if worker not in self._refused:
            self._refused[worker] = detail
            text = f"sweep: worker {worker} gets no more chunks: {detail}"
            print(text, file=sys.stderr, flush=True)


def _run_on_worker(task: ChunkTask, index: int) -> ChunkOutcome:
    return run_chunk(task, index, str(require("distributed").get_worker().address))
