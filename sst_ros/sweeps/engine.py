# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study on threads of this process, or on a Dask cluster whose workers may die.

A chunk depends on the study and its index alone, and its file appears whole. So a chunk may be
computed again, which changes no bit: where a worker dies or leaves before its chunks are taken, it
costs those that were sent to it. None is lost. A worker that does not fit (another version, no
space left) gets no more. A chunk that ends its workers is given up when all others are done.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from sst_ros.errors import InputError, Problem, SstError, require
from sst_ros.sweeps.prepared import prepare
from sst_ros.sweeps.results import name_part, write
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

NO_WORKER, NO_SCHEDULER = 60.0, 15.0
"""Longest wait for a worker that takes chunks, and for a scheduler that does not answer [s]."""

GATHER = 60.0
"""Longest wait for the outcome of a chunk that is done [s]: a busy worker answers late."""

NO_ANSWER = "the scheduler does not answer; continue with --resume"

MOST_DEATHS = 3
"""Times that a chunk is sent anew, beside others and then alone, where all its workers are gone."""

LOOK = 0.5
"""Longest time between two looks at the workers [s]."""

AHEAD = 4
"""Chunks sent to the scheduler for each thread: enough to keep it busy between two looks, few
enough to cancel, and for a worker to hold, with the study in each."""


class SweepFailed(SstError):
    """Chunks of a study could not be computed or written; the others are complete."""


@dataclass(frozen=True)
class ChunkOutcome:
    """A chunk that is done: its index, how often runs ended early how, and tables without files."""

    index: int
    reasons: Mapping[str, int]
    tables: tuple[pa.Table, pa.Table | None] | None


Compute: TypeAlias = Callable[[int], ChunkOutcome]
"""Computes a chunk: `run_chunk` of a study, its number of steps and its folder."""

Done: TypeAlias = Callable[[ChunkOutcome], None]
"""Is called with each outcome, by the thread that asked for the chunks."""


def run_chunk(study: SweepStudy, steps: int, folder: Path | None, index: int) -> ChunkOutcome:
    """Compute a chunk and write its files, if into a folder; raises OSError where they cannot."""
    ready = prepare(study, steps)
    table, trajectory = ready.chunk(index)
    counts = {row["values"]: row["counts"] for row in table["reason"].value_counts().to_pylist()}
    counts.pop("reached the end", None)
    if folder is None:
        return ChunkOutcome(index, counts, (table, trajectory))
    try:
        if trajectory is not None:
            write(trajectory, folder, name_part(index, "trajectory"), ready.about)
        write(table, folder, name_part(index), ready.about)
    except OSError as error:
        raise OSError(f"{folder}: {error}") from error
    return ChunkOutcome(index, counts, None)


def run_local(compute: Compute, chunks: Sequence[int], done: Done, workers: int) -> None:
    """Compute chunks on threads; raises SweepFailed where a file cannot be written."""
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(compute, index) for index in chunks]
        try:
            for future in as_completed(futures):
                done(future.result())
        except OSError as error:
            raise SweepFailed(str(error)) from error
        finally:
            pool.shutdown(cancel_futures=True)


def connect(address: str) -> Any:
    """Return a client of the scheduler at an address; raises InputError if none answers there."""
    distributed = require("distributed")
    try:
        return distributed.Client(address, timeout=NO_SCHEDULER, set_as_default=False)
    except (OSError, ValueError) as error:
        allowed = f"must be the address of a Dask scheduler, as tcp://host:8786 ({error})"
        raise InputError("sweep", [Problem("--scheduler", address, allowed)]) from None


def run_on_cluster(client: Any, compute: Compute, chunks: Sequence[int], done: Done) -> None:
    """Compute chunks on the workers of a client; print which of them get none, and why.

    Raises SweepFailed where chunks are not done, when all others are: no worker takes them, they
    end their workers, or the scheduler is gone.
    """
    run = _ClusterRun(client, compute, done)
    try:
        with client.as_current():
            # Dask blames all chunks that a worker had: the one that ends it shows itself alone.
            for suspect in run.work(chunks):
                run.failed |= run.work([suspect])
    except (OSError, *run.interrupted) as error:  # the connection is closed
        raise SweepFailed(f"{NO_ANSWER} ({error})") from error
    finally:
        if client.status == "running":
            client.cancel(list(run.running), force=True)
    if run.failed:
        raise SweepFailed("; ".join(f"chunk {i}: {run.failed[i]}" for i in sorted(run.failed)))


class _ClusterRun:
    """What is known of workers and chunks while a cluster works."""

    def __init__(self, client: Any, compute: Compute, done: Done) -> None:
        self._dask, self._client = require("distributed"), client
        self._compute, self._done = compute, done
        # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
        self.interrupted = TimeoutError, self._dask.TimeoutError, self._dask.CancelledError
        self.running: dict[Any, tuple[int, set[str]]] = {}  # chunk, and workers that may compute it
        self.failed: dict[int, str] = {}
        self._deaths = Counter[int]()
        self._faults: dict[str, str] = {}  # why a worker gets no chunks; empty where it gets some

    def work(self, chunks: Sequence[int]) -> dict[int, str]:
        """Compute chunks; return those whose workers died again and again, with Dask's error."""
        waiting, died, idle = list(chunks), dict[int, str](), time.monotonic()
        while waiting or self.running:
            threads = self._find_threads()
            if threads:
                idle = time.monotonic()
            elif time.monotonic() - idle > NO_WORKER:
                faults = "; ".join(f"{worker}: {text}" for worker, text in self._faults.items())
                why = f"{NO_WORKER:g} s ({faults or 'none is there'})"
                raise SweepFailed(f"no worker takes chunks for {why}")
            room = max(0, AHEAD * sum(threads.values()) - len(self.running))
            sent, waiting = waiting[:room], waiting[room:]
            given = {"key": "chunk", "pure": False, "workers": [*threads]}
            futures = self._client.map(_run_on_worker, sent, compute=self._compute, **given)
            self.running |= dict(zip(futures, ((i, {*threads}) for i in sent), strict=True))
            if not self.running:
                time.sleep(LOOK)
            with contextlib.suppress(*self.interrupted):
                self._dask.wait([*self.running], LOOK, "FIRST_COMPLETED")
            for future, (index, chosen) in [*self.running.items()]:
                taken = False
                if future.status != "pending":
                    with contextlib.suppress(*self.interrupted):  # its worker is gone since
                        taken = self._take(index, future, died)
                elif chosen.isdisjoint(threads):  # Dask would wait for workers that are all gone
                    self._client.cancel([future], force=True)
                    self._deaths[index] += 1
                    if taken := self._deaths[index] % MOST_DEATHS == 0:
                        died[index] = "its workers died"
                else:
                    continue
                del self.running[future]
                if not taken:
                    waiting.append(index)
        return died

    def _find_threads(self) -> dict[str, int]:
        """Threads of each worker that takes chunks; the others are named once."""
        end = time.monotonic() + NO_SCHEDULER
        while self._client.status != "running":
            if self._client.status == "closed" or time.monotonic() > end:
                raise SweepFailed(NO_ANSWER)
            time.sleep(0.1)
        # Not by scheduler_info(): another thread of the client empties what it is about to return.
        threads: dict[str, int] = self._client.nthreads()
        if new := [*(threads.keys() - self._faults.keys())]:
            # A worker of another version may not be able to read a study: it is asked by text.
            text = f"__import__({__name__!r}).sweeps.engine.describe_versions()"
            here = describe_versions()
            answers = self._client.run(eval, text, workers=new, on_error="return")
            for worker, there in answers.items():
                self._note(worker, "" if there == here else f"it has {there} in place of {here}")
        return {worker: n for worker, n in threads.items() if self._faults.get(worker) == ""}

    def _take(self, index: int, future: Any, died: dict[int, str]) -> bool:
        """Take what a chunk has come to; return False if it has to be computed again."""
        if future.status == "finished":
            found = future.result(timeout=GATHER)
            if isinstance(found, ChunkOutcome):
                self._done(found)
                return True
            self._note(*found)
        if future.status != "error":
            return False
        error = future.exception(timeout=GATHER)
        if isinstance(error, self._dask.KilledWorker):
            died[index] = str(error)
        else:
            name = "" if isinstance(error, SstError) else f"{type(error).__name__}: "
            self.failed[index] = f"{name}{error}"
        return True

    def _note(self, worker: str, fault: str) -> None:
        """Keep why a worker gets no chunks, and say so once."""
        if fault and not self._faults.get(worker):
            text = f"sweep: worker {worker} gets no more chunks: {fault}"
            print(text, file=sys.stderr, flush=True)
        self._faults[worker] = fault


def _run_on_worker(index: int, compute: Compute) -> ChunkOutcome | tuple[str, str]:
    """Run a chunk; where this worker cannot write it, return its address and why."""
    try:
        return compute(index)
    except OSError as error:
        return str(require("distributed").get_worker().address), str(error)


def describe_versions() -> str:
    """Versions on which the bits of results depend."""
    found = [f"{name} {require(name).__version__}" for name in ("numpy", "scipy", "numba")]
    return ", ".join(["python {}.{}".format(*sys.version_info), *found, f"sst_ros {VERSION}"])
