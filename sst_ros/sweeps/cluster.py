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
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar

from sst_ros.errors import SstError, refuse_errors, require
from sst_ros.version import VERSION

NO_WORKER = 60.0  # longest wait for a worker [s]
NO_SCHEDULER = 15.0  # longest wait for a scheduler that does not answer [s]
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
    """A worker cannot compute: its address, and the reason."""


def connect(address: str) -> Any:
    """Return a client of the scheduler at an address.

    Raises InputError if none answers there.
    """
    distributed = require("distributed")
    requirement = "must be the address of a Dask scheduler, as tcp://host:8786"
    refused = "--scheduler", address, requirement
    with refuse_errors("sweep", *refused, OSError, ValueError):
        return distributed.Client(address, timeout=NO_SCHEDULER, set_as_default=False)


def run_on_cluster(
    client: Any,
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    name: str = "run",
) -> Iterator[tuple[int, Result]]:
    """Call a function for each job; yield its number and its result when it is done.

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
    run = _ClusterRun(client, function, jobs, name)
    died: dict[int, str] = {}
    try:
        # Dask blames all jobs that a worker had: the one that ends it shows itself
        # alone.
        suspects = yield from run.compute(range(len(jobs)))
        for suspect in suspects:
            died |= yield from run.compute([suspect])
    except (OSError, *run.late, run.dask.CancelledError) as error:
        # the connection is closed
        text = f"the scheduler does not answer; continue with --resume ({error})"
        raise SweepFailed(text) from error
    finally:
        run.cancel()
    if died:
        reasons = (f"{name} {jobs[number]}: {died[number]}" for number in sorted(died))
        raise SweepFailed("; ".join(reasons))


class _ClusterRun:
    """The jobs of one call on the workers of a cluster."""

    def __init__(
        self,
        client: Any,
        function: Callable[[Any], Any],
        jobs: Sequence[Any],
        name: str,
    ) -> None:
        self.dask = require("distributed")
        # Before Python 3.11 asyncio's TimeoutError, which is Dask's, was another one.
        self.late = (TimeoutError, self.dask.TimeoutError)
        self._client = client
        self._jobs = jobs
        self._name = name
        self._sent: dict[Any, int] = {}  # numbers of jobs by their futures
        self._faults: dict[str, str] = {}  # of workers that were retired
        self._submit = partial(
            client.map,
            _on_worker,
            work=pickle.dumps((function, jobs)),
            versions=describe_versions(),
            pure=False,
        )

    def compute(
        self, numbers: Sequence[int]
    ) -> Generator[tuple[int, Any], None, dict[int, str]]:
        """Yield numbers and results of jobs.

        Returns those whose workers died again and again, with Dask's error.
        """
        died: dict[int, str] = {}
        self._sent.update(zip(self._submit(numbers), numbers, strict=True))
        pool = self.dask.as_completed(self._sent, loop=self._client.loop)
        worker_seen = time.monotonic()
        while self._sent:
            batch = pool.next_batch(block=False)
            if batch or self._client.nthreads():
                worker_seen = time.monotonic()
            elif time.monotonic() - worker_seen > NO_WORKER:
                raise SweepFailed(self._describe_no_worker())
            if not batch:
                time.sleep(LOOK)
            for future in batch:
                number = self._sent.pop(future)
                try:
                    yield number, future.result(timeout=GATHER)
                except UnfitWorker as error:
                    self._retire(*error.args)
                    (again,) = self._submit([number])
                    self._sent[again] = number
                    pool.add(again)
                except self.late:  # its worker is gone since: Dask computes it again
                    self._sent[future] = number
                    pool.add(future)
                except self.dask.KilledWorker as error:
                    died[number] = str(error)
                except SstError as error:
                    job = self._jobs[number]
                    raise SweepFailed(f"{self._name} {job}: {error}") from error
        return died

    def cancel(self) -> None:
        """Cancel what is not done, if the scheduler can still be asked to."""
        if self._client.status == "running":
            self._client.cancel(list(self._sent), force=True)

    def _describe_no_worker(self) -> str:
        faults = "; ".join(f"{worker}: {text}" for worker, text in self._faults.items())
        return f"no worker for {NO_WORKER:g} s ({faults or 'none is there'})"

    def _retire(self, worker: str, fault: str) -> None:
        """Take a worker out of the cluster, and say so once.

        Otherwise job after job fails on it.
        """
        if worker in self._faults:
            return
        self._faults[worker] = fault
        text = f"worker {worker} gets no more {self._name}s: {fault}"
        print(text, file=sys.stderr, flush=True)
        self._client.retire_workers([worker])


def _on_worker(number: int, work: bytes, versions: str) -> Any:
    """Run a job on this worker.

    Raises UnfitWorker where it has other versions or cannot write.
    """
    try:
        own_versions = describe_versions()
        if own_versions != versions:
            raise OSError(f"it has {own_versions} in place of {versions}")
        with _UNPICKLE_LOCK:  # prepared once, not by each thread
            function, jobs = _unpickle(work)
        return function(jobs[number])
    except (OSError, ImportError) as error:
        address = str(require("distributed").get_worker().address)
        raise UnfitWorker(address, str(error)) from None


# where the versions are known to be the sender's
_unpickle = lru_cache(maxsize=1)(pickle.loads)


def describe_versions() -> str:
    """Versions on which the bits of results depend."""
    numpy, scipy = (require(name).__version__ for name in ("numpy", "scipy"))
    versions = f"numpy {numpy}, scipy {scipy}, sst_ros {VERSION}"
    return "python {}.{}, ".format(*sys.version_info) + versions
