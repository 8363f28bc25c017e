# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study on a Dask cluster; workers may join, die, and run out of disk.

A chunk is a task of its own, so a killed worker costs the chunks that it was computing. A worker
that refuses a chunk (another version, no space left) gets no more of them. A chunk that ends its
worker again and again is given up when all others are done. Every wait has a bound.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sst_ros.errors import InputError, Problem, SstError
from sst_ros.extras import require
from sst_ros.host.cache_folder import cache_folder, store
from sst_ros.sweeps.chunk_task import DONE, ChunkOutcome, ChunkTask, SweepFailed, run_chunk

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


def send_code(client: Any, module: Any) -> None:
    """Send compiled code to each worker once, also to those that join later.

    A file's name is the digest of its source and of all versions, so a worker of another kind
    finds none of its own and compiles.
    """
    plugin = require("distributed").WorkerPlugin
    path = Path(getattr(module, "__file__", None) or "")
    files = {}
    if path.parent == cache_folder():
        for file in (path, *(path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]")):
            files[str(file.relative_to(path.parent))] = file.read_bytes()

    class SentCode(plugin):  # type: ignore[misc,valid-type]
        """Writes the files where they are missing."""

        def setup(self, worker: Any) -> None:
            store(files)

    client.register_plugin(SentCode(), name=f"sst_ros-{path.stem}")


def refuse_other_versions(client: Any, task: ChunkTask) -> dict[str, str]:
    """Return the workers that have other versions, and how they differ."""
    code = (
        f"__import__('sst_ros.sweeps.chunk_task', fromlist=['difference'])"
        f".difference({task.versions!r})"
    )
    found = client.run(eval, code, on_error="return")
    return {
        worker: f"this worker has {answer}" if isinstance(answer, str) else f"{answer!r}"
        for worker, answer in found.items()
        if answer != ""
    }


def run_on_cluster(
    client: Any,
    task: ChunkTask,
    chunks: Sequence[int],
    done: Callable[[ChunkOutcome], None],
    note: Callable[[str], None],
) -> None:
    """Compute chunks on the workers of a client.

    Args:
        client: of a Dask cluster.
        task: what all chunks have in common.
        chunks: indices of the chunks.
        done: is called with each outcome that is done.
        note: is called with messages about workers.

    Raises:
        SweepFailed: chunks are not done: no worker takes them, they end their workers, or the
            scheduler is gone. All others are.

    """
    with client.as_current():
        _Run(client, task, done, note).run(list(chunks))


class _Run:
    def __init__(self, client: Any, task: ChunkTask, done: Any, note: Any) -> None:
        self._distributed = require("distributed")
        self._closed = require("distributed.comm").CommClosedError
        # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
        self._waits = TimeoutError, self._distributed.TimeoutError, self._distributed.CancelledError
        self._client, self._task, self._done, self._note = client, task, done, note
        self._refused: dict[str, str] = {}
        self._running: dict[Any, tuple[int, tuple[str, ...] | None]] = {}
        self._deaths: Counter[int] = Counter()
        self._given_up: dict[int, str] = {}

    def run(self, waiting: list[int]) -> None:
        waiting.reverse()
        try:
            for worker, detail in refuse_other_versions(self._client, self._task).items():
                self._refuse(worker, detail)
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
            workers = self._workers()
            if workers:
                idle = time.monotonic()
            elif time.monotonic() - idle > NO_WORKER:
                raise SweepFailed(self._no_worker())
            waiting += self._stranded(set(workers))
            room = AHEAD * sum(workers.values()) - len(self._running)
            for _ in range(min(room, len(waiting))):
                self._submit(waiting.pop(), tuple(workers))
            waiting += self._collect()

    def _submit(self, index: int, workers: tuple[str, ...]) -> None:
        """Send a chunk: to any worker, or where some are refused to one of the others."""
        chosen = workers if self._refused else None
        future = self._client.submit(
            _task_on_worker,
            self._task,
            index,
            pure=False,
            workers=chosen,
            allow_other_workers=False,
            key=f"chunk-{index}-{time.monotonic_ns()}",
        )
        self._running[future] = index, chosen

    def _stranded(self, workers: set[str]) -> list[int]:
        """Take back chunks whose chosen workers are all gone."""
        stranded = [
            future
            for future, (_, chosen) in self._running.items()
            if chosen is not None and not workers & set(chosen) and future.status == "pending"
        ]
        again = [self._running.pop(future)[0] for future in stranded]
        if stranded:
            self._client.cancel(stranded, force=True)
        return again

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
            try:
                if future.status == "finished":
                    again += self._take(index, future.result(timeout=GATHER))
                elif future.status == "error":
                    again += self._failed(index, future.exception(timeout=GATHER))
                else:
                    again.append(index)
            except self._waits:
                again.append(index)  # the worker that held the outcome is gone
            future.release()
        return again

    def _take(self, index: int, outcome: ChunkOutcome) -> list[int]:
        if outcome.status == DONE:
            self._done(outcome)
            return []
        self._refuse(outcome.worker, outcome.detail)
        return [index]

    def _failed(self, index: int, error: BaseException | None) -> list[int]:
        if isinstance(error, self._distributed.KilledWorker):
            self._deaths[index] += 1
            if self._deaths[index] < MOST_DEATHS:
                return [index]
            self._given_up[index] = f"its workers died {MOST_DEATHS} times ({error})"
            return []
        if isinstance(error, SstError):
            self._given_up[index] = str(error)
            return []
        self._given_up[index] = f"{type(error).__name__}: {error}"
        return []

    def _refuse(self, worker: str, detail: str) -> None:
        if worker not in self._refused:
            self._refused[worker] = detail
            self._note(f"worker {worker} gets no more chunks: {detail}")

    def _workers(self) -> dict[str, int]:
        """Threads of each worker that takes chunks."""
        if not self._alive():
            raise SweepFailed(NO_ANSWER)
        info = self._client.scheduler_info(n_workers=-1)["workers"]
        return {
            address: about["nthreads"]
            for address, about in info.items()
            if address not in self._refused
        }

    def _alive(self) -> bool:
        began = time.monotonic()
        while self._client.status != "running":
            if self._client.status == "closed" or time.monotonic() - began > NO_SCHEDULER:
                return False
            time.sleep(0.1)
        return True

    def _no_worker(self) -> str:
        refused = "; ".join(f"{worker}: {text}" for worker, text in self._refused.items())
        return f"no worker takes chunks for {NO_WORKER:g} s ({refused or 'none is there'})"


def _task_on_worker(task: ChunkTask, index: int) -> ChunkOutcome:
    address = str(require("distributed").get_worker().address)
    return run_chunk(task, index, address)
