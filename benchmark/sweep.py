# SPDX-License-Identifier: Apache-2.0
"""A study of a million runs against its own kernel.

python -m benchmark.sweep [--rows 1000000]

Example 2, one second, DOP853 by the steps that reach 1e-9 rad, the inertia of every
body varied by a factor of its own, final states to Parquet.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.measure import describe_machine, join_line, read_options
from sst_ros import load_scene, sweep
from sst_ros.integration.many_runs import run_many
from sst_ros.sweeps.sweep import PreparedSweep, read_sweep, run_chunk
from sst_ros.sweeps.sweep_study import CHUNK_ROWS, SweepStudy

BODIES = (
    "star",
    *(
        f"{links}[{k}]"
        for links in ("actuated_links", "intermediate_links")
        for k in range(3)
    ),
)
VARY = {f"{body}.inertia": ("uniform", 0.9, 1.1, "relative") for body in BODIES}
ROUNDS, CHUNKS = 3, 16
"""What is compared takes turns, so many times, each with so many chunks."""


def study_of(rows: int) -> SweepStudy:
    return SweepStudy(load_scene("example2_heavy"), VARY, n=rows, seed=1)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; the exit status is 0."""
    options = read_options("sweep", __doc__, arguments, rows=1_000_000)
    ratios: dict[str, Any] = {
        "machine": describe_machine("numpy", "llvmlite", "dask", "pyarrow")
    }
    began = time.perf_counter()
    sweep("example2_heavy", VARY, n=1000, progress=False)
    ratios["seconds of the first 1,000 rows, imports and code"] = (
        time.perf_counter() - began
    )
    ratios |= _study(options.rows)
    began = time.perf_counter()
    _arrays(PreparedSweep(study_of(100_000), ratios["steps"]))
    ratios["seconds to prepare 1e5 rows"] = time.perf_counter() - began
    ratios |= _ratios(ratios["steps"])
    for name, value in ratios.items():
        if name != "machine":
            print(f"{name:>44}: {value:.6g}")
    print(join_line(ratios["machine"]))
    return 0


def _study(rows: int) -> dict[str, float]:
    """The whole study, preparation and files included."""
    with tempfile.TemporaryDirectory() as folder:
        began, processor = time.perf_counter(), time.process_time()
        study = study_of(rows)
        ready = PreparedSweep(study)
        prepared_s = time.perf_counter() - began
        _chunks(ready, folder)
        seconds, processor = (
            time.perf_counter() - began,
            time.process_time() - processor,
        )
        size = sum(path.stat().st_size for path in Path(folder).iterdir())
        table = read_sweep(Path(folder))
        reading = time.perf_counter() - began - seconds
    assert len(table) == rows
    assert (table["status"] == 0).all()
    return {
        "rows": rows,
        "steps": ready.steps,
        "error of pilot rows [rad]": ready.pilot_error,
        "seconds": seconds,
        "of these to choose the steps": prepared_s,
        "seconds to read the files again": reading,
        "us a run": 1e6 * seconds / rows,
        "us a run, processor time": 1e6 * processor / rows,
        "files [MB]": size / 1e6,
        "largest memory [GB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def _arrays(ready: PreparedSweep) -> tuple[Any, list[Any]]:
    """Sample and check all rows; return their batch, states, inputs and codes."""
    study = ready.study
    values = study.draw(0, study.rows)
    scenarios, _, _ = ready.scenarios(values)
    batch = ready.batch.with_parameters(scenarios)
    y, code = batch.initial(study.scene.initial.gamma, (0.0, 0.0, 0.0))
    return batch, [y, batch.drives((0.0, 0.0, 0.0), study.rows), code]


def _ratios(steps: int) -> dict[str, float]:
    """Chunks, files included, against the compiled loop alone on prepared arrays, on
    all cores.

    Also in processor time, which a busy machine changes less.
    """
    ready = PreparedSweep(study_of(CHUNKS * CHUNK_ROWS), steps)
    study = ready.study
    batch, (y, given, code) = _arrays(ready)
    times = []
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory() as folder:
            whole = _timed(partial(_chunks, ready, folder))
        more = np.full(study.rows, np.nan), np.zeros(study.rows)
        arrays = y.copy(), given, code.copy(), *more
        alone = _timed(partial(batch.advance, 0, steps, study.length / steps, *arrays))
        times.append((whole, alone))
    quotients = np.median([np.divide(*both) for both in times], axis=0)
    least = 1e6 * np.min(times, axis=0) / study.rows
    return {
        "us a run, kernel alone": least[1, 0],
        "us a run, kernel alone, processor time": least[1, 1],
        "ratio to the kernel": quotients[0],
        "ratio to the kernel, processor time": quotients[1],
    }


def _chunks(ready: PreparedSweep, folder: str) -> None:
    """Compute and write all chunks of a study, on all cores."""
    work, chunks = partial(run_chunk, ready, Path(folder)), range(ready.study.chunks)
    deque(run_many(work, chunks, workers=0), maxlen=0)


def _timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of a call, and of all processors."""
    began, processor = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - began, time.process_time() - processor


if __name__ == "__main__":
    sys.exit(main())
