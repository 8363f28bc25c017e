# SPDX-License-Identifier: Apache-2.0
"""Many runs of one function on the workers of a Dask cluster.

A result depends on its job alone. So a job may be computed again, which changes no bit:
Dask does it where a worker dies or, by its `worker-ttl`, gives no sign of life. A
worker that does not fit (another version, no space left) is retired.
"""

from __future__ import annotations

import pickle
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

from sst_ros.errors import SstError, refuse_errors, require
from sst_ros.version import VERSION

NO_WORKER, NO_SCHEDULER = 60.0, 15.0
"""Longest wait for a worker, and for a scheduler that does not answer [s]."""

# longest wait for the outcome of a job that is done [s]: a busy worker answers late
GATHER = 60.0
LOOK = 0.1  # time between two looks for jobs that are done, and for workers [s]
Job = TypeVar("Job")
Result = TypeVar("Result")
_UNPICKLE_LOCK = threading.Lock()


class SweepFailed(SstError):
    """Runs could not be computed or their results not written.

    The others are complete.
    """


class UnfitWorker(SstError):
    """A worker cannot compute: its address, and why."""


def connect(address: str) -> Any:
    """Return a client of the scheduler at an address.

    Raises InputError if none answers there.
    """
    distributed = require("distributed")
    is_address = (
        "--scheduler",
        address,
        "must be the address of a Dask scheduler, as tcp://host:8786",
    )
    with refuse_errors("sweep", *is_address, OSError, ValueError):
        return distributed.Client(address, timeout=NO_SCHEDULER, set_as_default=False)


def run_on_cluster(
    client: Any,
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    name: str = "run",
) -> Iterator[tuple[int, Result]]:
    """Call a function for each job.

    Yield the number of the job and the result when it is done.

    Workers that are retired are printed, with the reason.

    Args:
        client: a dask.distributed client, whose workers compute.
        function: what is called; each worker unpickles it once.
        jobs: its arguments.
        name: what a job is called in messages.

    Raises:
        SweepFailed: an SstError of a job, no worker, or no scheduler; or, when all
            other jobs are done, a job that ended its workers.

    """
    dask, sent, faults = require("distributed"), dict[Any, int](), dict[str, str]()
    work = pickle.dumps((function, jobs))
    ask = partial(
        client.map, _on_worker, work=work, versions=describe_versions(), pure=False
    )
    # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
    late = TimeoutError, dask.TimeoutError

    def compute(
        numbers: Iterable[int],
    ) -> Generator[tuple[int, Result], None, dict[int, str]]:
        """Return those whose workers died again and again, with Dask's error."""
        died, seen = dict[int, str](), time.monotonic()
        sent.update(zip(ask(numbers), numbers, strict=True))
        pool = dask.as_completed(sent, loop=client.loop)
        while sent:
            batch = pool.next_batch(block=False)
            if batch or client.nthreads():
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER:
                why = "; ".join(
                    f"{worker}: {fault}" for worker, fault in faults.items()
                )
                raise SweepFailed(
                    f"no worker for {NO_WORKER:g} s ({why or 'none is there'})"
                )
            if not batch:
                time.sleep(LOOK)
            for future in batch:
                number = sent.pop(future)
                try:
                    yield number, future.result(timeout=GATHER)
                except UnfitWorker as error:
                    retire(*error.args)
                    (again,) = ask([number])
                    sent[again] = number
                    pool.add(again)
                except late:  # its worker is gone since: Dask computes it again
                    sent[future] = number
                    pool.add(future)
                except dask.KilledWorker as error:
                    died[number] = str(error)
                except SstError as error:
                    raise SweepFailed(f"{name} {jobs[number]}: {error}") from error
        return died

    def retire(worker: str, fault: str) -> None:
        """Take a worker out of the cluster, and say so once.

        Otherwise job after job fails on it.
        """
        if worker not in faults:
            faults[worker] = fault
            print(
                f"worker {worker} gets no more {name}s: {fault}",
                file=sys.stderr,
                flush=True,
            )
            client.retire_workers([worker])

    failed: dict[int, str] = {}
    try:
        # Dask blames all jobs that a worker had: the one that ends it shows itself
        # alone.
        for suspect in (yield from compute(range(len(jobs)))):
            failed |= yield from compute([suspect])
    except (OSError, *late, dask.CancelledError) as error:  # the connection is closed
        text = f"the scheduler does not answer; continue with --resume ({error})"
        raise SweepFailed(text) from error
    finally:
        if client.status == "running":
            client.cancel(list(sent), force=True)
    if failed:
        raise SweepFailed(
            "; ".join(f"{name} {jobs[k]}: {failed[k]}" for k in sorted(failed))
        )


def _on_worker(number: int, work: bytes, versions: str) -> Any:
    """Run a job on this worker.

    Raises UnfitWorker where it has other versions or cannot write.
    """
    try:
        if (here := describe_versions()) != versions:
            raise OSError(f"it has {here} in place of {versions}")
        with _UNPICKLE_LOCK:  # prepared once, not by each thread
            function, jobs = _unpickle(work)
        return function(jobs[number])
    except (OSError, ImportError) as error:
        raise UnfitWorker(
            str(require("distributed").get_worker().address), str(error)
        ) from None


# where the versions are known to be the sender's
_unpickle = lru_cache(maxsize=1)(pickle.loads)


def describe_versions() -> str:
    """Versions on which the bits of results depend."""
    numpy, scipy = (require(name).__version__ for name in ("numpy", "scipy"))
    versions = f"numpy {numpy}, scipy {scipy}, sst_ros {VERSION}"
    return "python {}.{}, ".format(*sys.version_info) + versions
