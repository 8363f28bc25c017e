# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study on threads of this process, or on a Dask cluster whose workers may die.

A chunk is a task of its own, so a killed worker costs the chunks that it was computing. A worker
that does not fit (another version, no space left) gets no more of them. A chunk that ends its
workers again and again is given up when all others are done. Every wait has a bound.
"""

from __future__ import annotations

import contextlib
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from sst_ros.errors import InputError, Problem, SstError, require
from sst_ros.host.cache_folder import cache_folder, store
from sst_ros.sweeps.prepared import prepare
from sst_ros.sweeps.results import name_part, write
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

NO_WORKER, NO_SCHEDULER = 60.0, 15.0
"""Longest wait for a worker that takes chunks, and for a scheduler that does not answer [s]."""

GATHER = 10.0
"""Longest wait for the outcome of a chunk that is done [s]."""

NO_ANSWER = "the scheduler does not answer; continue with --resume"

MOST_DEATHS = 5
"""Attempts at a chunk whose workers die; Dask itself makes three of each."""

POLL = 0.05
"""Time between two looks at the chunks of a cluster [s]."""

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
    client: Any, compute: Compute, folder: Path | None, chunks: Sequence[int], done: Done
) -> None:
    """Compute chunks on the workers of a client; print what it finds out about them.

    Raises SweepFailed where chunks are not done, when all others are: no worker takes them, they
    end their workers, or the scheduler is gone.
    """
    # A worker of another version may not be able to read a study: it is asked by text first.
    check = f"find_unfit({list_versions()!r}, {None if folder is None else str(folder)!r})"
    run = _Run(client, compute, f"__import__('sst_ros.sweeps.engine').sweeps.engine.{check}", done)
    closed = require("distributed.comm").CommClosedError
    try:
        with client.as_current():
            run.work(list(chunks))
    except (closed, *run.waits) as error:
        raise SweepFailed(f"{NO_ANSWER} ({error})") from error
    finally:
        if client.status == "running":
            client.cancel(list(run.running), force=True)
    if run.given_up:
        texts = [f"chunk {index}: {text}" for index, text in sorted(run.given_up.items())]
        raise SweepFailed("; ".join(texts))


class _Run:
    """What is known of workers and chunks while a cluster works."""

    def __init__(self, client: Any, compute: Compute, check: str, done: Done) -> None:
        distributed = require("distributed")
        self._killed = distributed.KilledWorker
        # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
        self.waits = TimeoutError, distributed.TimeoutError, distributed.CancelledError
        self._client, self._compute, self._check, self._done = client, compute, check, done
        self.running: dict[Any, tuple[int, set[str]]] = {}  # chunk and chosen workers, or none
        self._unfit: dict[str, str] = {}  # why a worker gets no chunks
        self._deaths = Counter[int]()
        self.given_up: dict[int, str] = {}

    def work(self, waiting: list[int]) -> None:
        """Compute chunks; they are sent to all workers, or where some are unfit to the others."""
        for worker, answer in self._client.run(eval, self._check, on_error="return").items():
            self._refuse(worker, answer if isinstance(answer, str) else repr(answer))
        idle = time.monotonic()
        while waiting or self.running:
            threads = self._find_threads()
            if threads:
                idle = time.monotonic()
            elif time.monotonic() - idle > NO_WORKER:
                refused = "; ".join(f"{worker}: {text}" for worker, text in self._unfit.items())
                why = f"{NO_WORKER:g} s ({refused or 'none is there'})"
                raise SweepFailed(f"no worker takes chunks for {why}")
            for future, (index, chosen) in [*self.running.items()]:
                # Dask would wait for chosen workers that are all gone.
                if chosen and chosen.isdisjoint(threads) and future.status == "pending":
                    self._client.cancel([future], force=True)
                    del self.running[future]
                    waiting.append(index)
            room = AHEAD * sum(threads.values()) - len(self.running)
            if waiting and room > 0:
                sent, waiting = waiting[:room], waiting[room:]
                chosen = {*threads} if self._unfit else set()
                futures = self._client.map(
                    _run_on_worker, sent, compute=self._compute, check=self._check, pure=False,
                    workers=list(chosen) or None, key=f"chunk-{time.monotonic_ns()}",
                )  # fmt: skip
                self.running |= {
                    one: (index, chosen) for one, index in zip(futures, sent, strict=True)
                }
            time.sleep(POLL)
            waiting += self._collect()

    def _find_threads(self) -> dict[str, int]:
        """Threads of each worker that is not unfit."""
        end = time.monotonic() + NO_SCHEDULER
        while self._client.status != "running":
            if self._client.status == "closed" or time.monotonic() > end:
                raise SweepFailed(NO_ANSWER)
            time.sleep(0.1)
        workers = self._client.scheduler_info(n_workers=-1)["workers"].items()
        return {name: about["nthreads"] for name, about in workers if name not in self._unfit}

    def _collect(self) -> list[int]:
        """Take what has ended; return the chunks to be computed again."""
        again = []
        for future in [one for one in self.running if one.status != "pending"]:
            (index, _), taken = self.running.pop(future), False
            with contextlib.suppress(*self.waits):  # the worker that held the outcome is gone
                taken = self._take(index, future)
            future.release()
            if not taken:
                again.append(index)
        return again

    def _take(self, index: int, future: Any) -> bool:
        """Take the outcome of a chunk; return False if it has to be computed again."""
        if future.status == "finished":
            found = future.result(timeout=GATHER)
            if isinstance(found, ChunkOutcome):
                self._done(found)
                return True
            self._refuse(*found)
        if future.status != "error":
            return False
        error = future.exception(timeout=GATHER)
        if isinstance(error, self._killed):
            self._deaths[index] += 1
            if self._deaths[index] < MOST_DEATHS:
                return False
            self.given_up[index] = f"its workers died {MOST_DEATHS} times ({error})"
        else:
            name = "" if isinstance(error, SstError) else f"{type(error).__name__}: "
            self.given_up[index] = f"{name}{error}"
        return True

    def _refuse(self, worker: str, unfit: str) -> None:
        """Give a worker no more chunks where it is unfit, and say so once."""
        if unfit and worker not in self._unfit:
            self._unfit[worker] = unfit
            text = f"sweep: worker {worker} gets no more chunks: {unfit}"
            print(text, file=sys.stderr, flush=True)


def _run_on_worker(index: int, compute: Compute, check: str) -> ChunkOutcome | tuple[str, str]:
    """Run a chunk; where this worker is not fit for it, return its address and why."""
    try:
        fault = eval(check)
        if not fault:
            return compute(index)
    except OSError as error:
        fault = str(error)
    return str(require("distributed").get_worker().address), fault


def list_versions() -> dict[str, str]:
    """Versions on which the bits of results depend."""
    found = {name: require(name).__version__ for name in ("numpy", "scipy", "numba")}
    python = ".".join(platform.python_version_tuple()[:2])
    return {"sst_ros": VERSION, "python": python, **found}


def find_unfit(versions: Mapping[str, str], folder: str | None) -> str:
    """Return why this process can compute no chunk, or write none; empty where it can."""
    here = list_versions()
    differs = ", ".join(
        f"{name} {here.get(name, 'missing')} in place of {version}"
        for name, version in versions.items()
        if here.get(name) != version
    )
    if differs:
        return f"this worker has {differs}"
    if folder is None or Path(folder).is_dir():
        return ""
    return f"{folder} is not there: workers need the folder of --out on a shared disk"
