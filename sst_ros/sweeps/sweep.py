# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene: chunks of a study on threads of this process, or on a Dask cluster.

A chunk depends on the study and its index alone, and its file appears whole. So a chunk may be
computed again, which changes no bit: Dask does it where a worker dies or, by its `worker-ttl`,
gives no sign of life. A worker that does not fit (another version, no space left) is retired.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from sst_ros.errors import InputError, Problem, SstError, refuse_unless, require
from sst_ros.host.output import TEMPORARY, Bar, require_free, write_into
from sst_ros.scene.scene import scene_of
from sst_ros.sweeps.prepared import PreparedSweep
from sst_ros.sweeps.results import find_complete, read_sweep, to_frame, write_part
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pandas as pd

NO_WORKER, NO_SCHEDULER = 60.0, 15.0
"""Longest wait for a worker, and for a scheduler that does not answer [s]."""

GATHER = 60.0
"""Longest wait for the outcome of a chunk that is done [s]: a busy worker answers late."""

NO_ANSWER = "the scheduler does not answer; continue with --resume"

LOOK = 0.1
"""Time between two looks for chunks that are done, and for workers [s]."""

Done: TypeAlias = Callable[[int, Mapping[str, int], Any], None]
"""Is called by the thread that asked for the chunks with each that is done: its index, how often
runs ended early how, and its table where there is no file."""

_LOCK = threading.Lock()


class SweepFailed(SstError):
    """Chunks of a study could not be computed or written; the others are complete."""


class UnfitWorker(SstError):
    """A worker cannot compute chunks: its address, and why."""


def sweep(
    scene: Any,
    vary: Mapping[str, Any],
    *,
    torque: Any = None,
    duration: float | None = None,
    n: int | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    client: Any = None,
    workers: int = 0,
    resume: bool = False,
    progress: bool = True,
    **options: Any,
) -> pd.DataFrame:
    """Run a scene many times with other numbers, and return a table with a row for each run.

    Args:
        scene: a Scene, its name, its path, or its document as a dict.
        vary: distribution or values by key of the scene, as in {"star.inertia": ("uniform", 0.8,
            1.2, "relative"), "initial.gamma": ("normal", 0.785, 0.05)}; or a table (a DataFrame)
            with a row for each run.
        torque: None for the scene's own torques over time if it has some, else zero; three constant
            torques [N m]; or a SineTorque.
        duration: length of a run [s]; by default that of the scene.
        n: number of runs; by default that of the grid or of the table.
        seed: of the random numbers. Row i depends on the seed and on i alone.
        out: folder of the results as Parquet files, one a chunk; nothing is written without it.
        client: a dask.distributed client; by default threads of this process.
        workers: number of threads without a client; 0 for one a core.
        resume: compute only the chunks that are missing in `out`.
        progress: draw a bar on a terminal.
        options: `sampling`, `tolerance`, `steps`, `control`, `outputs` and `chunk` of `SweepStudy`.

    Returns:
        Inputs, how each run ended (`status`, `reason`, `t`), `local_error`, and the outputs; units
        in `attrs`.

    Raises:
        InputError: an argument or a value in the study is not allowed; nothing has run then.
        SweepFailed: chunks could not be computed or written; those that are done remain.
        MissingDependency: pandas, pyarrow or numba is not installed.

    """
    rows = {"table" if hasattr(vary, "columns") else "vary": vary}
    given = {"torque": torque, "duration": duration, "n": n, "seed": seed, **options, **rows}
    study = SweepStudy.from_values({"scene": scene_of(scene), **given})
    path, run = None if out is None else Path(out), {"resume": resume, "progress": progress}
    return run_study(study, path, client=client, workers=workers, **run)


def run_study(
    study: SweepStudy,
    out: Path | None,
    *,
    client: Any = None,
    workers: int = 0,
    resume: bool = False,
    progress: bool = True,
) -> pd.DataFrame:
    """Run a study and return its table; see `sweep`."""
    for module in ("pandas", "pyarrow"):
        require(module)
    whole = type(workers) is int and 0 <= workers <= 1024
    refuse_unless(
        "sweep",
        ("workers", workers, whole, "must be a whole number from 0 to 1024"),
        ("resume", resume, out is not None or not resume, "needs out"),
    )
    complete, steps = set[int](), None
    if out is not None:
        out = out.resolve() if resume else require_free(out.resolve(), "sweep")
        # With the number of steps that was chosen when it was started.
        complete, steps = find_complete(out, study)
    ready = PreparedSweep(study, steps)
    if study.table is not None:  # refuse rows that make no scene, before anything runs
        ready.check(study.draw(0, study.rows))
    if out is not None:
        with write_into(out, "sweep"):
            for left in out.glob(f"{TEMPORARY}*"):  # by killed processes
                left.unlink(missing_ok=True)
    missing = [index for index in range(study.chunks) if index not in complete]
    total = sum(len(study.rows_of(index)) for index in missing)
    bar, began, reasons, runs = Bar("sweep", progress), time.monotonic(), Counter[str](), 0
    tables: dict[int, Any] = {}

    def done(index: int, early: Mapping[str, int], table: Any) -> None:
        """Keep a chunk, and show the runs that are done and how the early ones ended."""
        nonlocal runs
        runs += len(study.rows_of(index))
        reasons.update(early)
        tables[index] = table
        rate = max(runs / max(time.monotonic() - began, 1e-9), 1e-9)
        text = f"{rate:.0f} runs/s, {(total - runs) / rate:.0f} s left"
        if reasons:
            common = (f"{count} {reason}" for reason, count in reasons.most_common(3))
            text += f"; early: {', '.join(common)}"
        bar.draw(1.0 - (total - runs) / study.rows, text)

    if client is not None:
        run_on_cluster(client, pickle.dumps((study, ready.steps, out)), missing, done)
    else:
        run_local(ready, out, missing, done, workers or len(os.sched_getaffinity(0)))
    if out is not None:
        return read_sweep(out)
    parts = [tables[index] for index in range(study.chunks)]
    return to_frame(require("pyarrow").concat_tables(parts), ready.about)


def run_chunk(ready: PreparedSweep, out: Path | None, index: int) -> tuple[dict[str, int], Any]:
    """Return how runs of a chunk ended early, and its table if there is no folder for its file.

    Raises OSError where the file cannot be written.
    """
    table = ready.chunk(index)
    counts = {row["values"]: row["counts"] for row in table["reason"].value_counts().to_pylist()}
    counts.pop("reached the end", None)
    if out is None:
        return counts, table
    try:
        write_part(table, out, index, ready.about)
    except OSError as error:
        raise OSError(f"{out}: {error}") from error
    return counts, None


def run_local(
    ready: PreparedSweep, out: Path | None, chunks: Sequence[int], done: Done, workers: int
) -> None:
    """Compute chunks on threads; raises SweepFailed where a file cannot be written."""
    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(run_chunk, ready, out, index): index for index in chunks}
        try:
            for future in as_completed(futures):
                done(futures[future], *future.result())
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


def run_on_cluster(client: Any, job: bytes, chunks: Sequence[int], done: Done) -> None:
    """Compute chunks on the workers of a client; print which of them are retired, and why.

    `job` is the pickled study, its number of steps and the folder of its files. Raises SweepFailed
    where a chunk fails, no worker is there or the scheduler is gone; and, when all other chunks are
    done, where a chunk ends its workers.
    """
    dask, sent, faults = require("distributed"), dict[Any, int](), dict[str, str]()
    ask = partial(client.map, run_on_worker, job=job, versions=describe_versions(), pure=False)
    # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
    late = TimeoutError, dask.TimeoutError

    def work(chunks: Sequence[int]) -> dict[int, str]:
        """Compute chunks; return those whose workers died again and again, with Dask's error."""
        died, seen = dict[int, str](), time.monotonic()
        sent.update(zip(ask(chunks), chunks, strict=True))
        pool = dask.as_completed(sent, loop=client.loop)
        while sent:
            batch = pool.next_batch(block=False)
            if batch or client.nthreads():
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER:
                why = "; ".join(f"{worker}: {fault}" for worker, fault in faults.items())
                raise SweepFailed(f"no worker for {NO_WORKER:g} s ({why or 'none is there'})")
            if not batch:
                time.sleep(LOOK)
            for future in batch:
                index = sent.pop(future)
                try:
                    done(index, *future.result(timeout=GATHER))
                except UnfitWorker as error:
                    retire(*error.args)
                    (again,) = ask([index])
                    sent[again] = index
                    pool.add(again)
                except late:  # its worker is gone since: Dask computes it again
                    sent[future] = index
                    pool.add(future)
                except dask.KilledWorker as error:
                    died[index] = str(error)
                except SstError as error:
                    raise SweepFailed(f"chunk {index}: {error}") from error
        return died

    def retire(worker: str, fault: str) -> None:
        """Take a worker out of the cluster, and say so once: else chunk after chunk fails on it."""
        if worker not in faults:
            faults[worker] = fault
            text = f"sweep: worker {worker} gets no more chunks: {fault}"
            print(text, file=sys.stderr, flush=True)
            client.retire_workers([worker])

    failed: dict[int, str] = {}
    try:
        # Dask blames all chunks that a worker had: the one that ends it shows itself alone.
        for suspect in work(chunks):
            failed |= work([suspect])
    except (OSError, *late, dask.CancelledError) as error:
        raise SweepFailed(f"{NO_ANSWER} ({error})") from error  # the connection is closed
    finally:
        if client.status == "running":
            client.cancel(list(sent), force=True)
    if failed:
        raise SweepFailed("; ".join(f"chunk {i}: {failed[i]}" for i in sorted(failed)))


def run_on_worker(index: int, job: bytes, versions: str) -> tuple[dict[str, int], Any]:
    """Run a chunk; raises UnfitWorker where this worker has other versions or cannot write."""
    try:
        if (here := describe_versions()) != versions:
            raise OSError(f"it has {here} in place of {versions}")
        with _LOCK:  # prepared once, not by each thread
            ready, out = _unpack(job)
        return run_chunk(ready, out, index)
    except (OSError, ImportError) as error:
        address = require("distributed").get_worker().address
        raise UnfitWorker(str(address), str(error)) from None


@lru_cache(maxsize=1)
def _unpack(job: bytes) -> tuple[PreparedSweep, Path | None]:
    """Prepare a study, unpickled where the versions are known to be those of its sender."""
    study, steps, out = pickle.loads(job)
    return PreparedSweep(study, steps), out


def describe_versions() -> str:
    """Versions on which the bits of results depend."""
    found = [f"{name} {require(name).__version__}" for name in ("numpy", "scipy", "numba")]
    return ", ".join(["python {}.{}".format(*sys.version_info), *found, f"sst_ros {VERSION}"])
