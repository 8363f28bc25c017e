# SPDX-License-Identifier: Apache-2.0
"""A study of a million runs against its own kernel, MuJoCo, and two workers against one.

python -m benchmark.sweep [--rows 1000000] [--mujoco] [--cluster] [--json FILE]

Example 2, one second, DOP853 by the steps that reach 1e-9 rad, the inertia of every body varied by
a factor of its own, final states to Parquet.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.measure import describe_machine, join_line, write_json
from sst_ros import load_scene, simulate, sweep
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.sweeps.chunk_task import ChunkTask, list_versions, read_sweep, run_chunk, run_local
from sst_ros.sweeps.prepared import prepare
from sst_ros.sweeps.sweep_study import CHUNK, SweepStudy

BODIES = (
    "star",
    *(f"{links}[{k}]" for links in ("actuated_links", "intermediate_links") for k in range(3)),
)
VARY = {f"{body}.inertia": ("uniform", 0.9, 1.1, "relative") for body in BODIES}
MUJOCO_STEPS = 2780
"""Steps, with the softness below, by which rollout reaches 1e-6 rad soonest (docs/peers.csv)."""

HASHES = 4_000_000
"""Repetitions of SHA-256, some seconds."""

RUNS = 1e9
ROUNDS, CHUNKS = 3, 16
"""What is compared takes turns, so many times, each with so many chunks."""


def study_of(rows: int) -> SweepStudy:
    return SweepStudy(load_scene("example2_heavy"), VARY, n=rows, seed=1)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; the exit status is 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.sweep", description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--mujoco", action="store_true", help="time MuJoCo's rollout, too")
    parser.add_argument("--cluster", action="store_true", help="time Dask workers, too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    found: dict[str, Any] = {"machine": describe_machine("numpy", "numba", "dask", "pyarrow")}
    began = time.perf_counter()
    sweep("example2_heavy", VARY, n=1000, progress=False)
    found["seconds of the first 1,000 rows, imports and code"] = time.perf_counter() - began
    found |= _study(options.rows)
    began = time.perf_counter()
    _arrays(study_of(100_000), found["steps"])
    found["seconds to prepare 1e5 rows"] = time.perf_counter() - began
    found |= _ratios(found["steps"])
    if options.mujoco:
        found |= _mujoco(found["us a run"])
    if options.cluster:
        found |= _cluster(found["steps"])
    for name, value in found.items():
        if name != "machine":
            print(f"{name:>44}: {value:.6g}")
    print(join_line(found["machine"]))
    write_json(options.json, found)
    return 0


def _study(rows: int) -> dict[str, float]:
    """The whole study, preparation and files included."""
    with tempfile.TemporaryDirectory() as folder:
        began, processor = time.perf_counter(), time.process_time()
        study = study_of(rows)
        ready = prepare(study)
        prepared_s = time.perf_counter() - began
        _chunks(study, ready.steps, folder)
        seconds, processor = time.perf_counter() - began, time.process_time() - processor
        size = sum(path.stat().st_size for path in Path(folder).iterdir())
        table = read_sweep(Path(folder))
        reading = time.perf_counter() - began - seconds
    assert len(table) == rows
    assert (table["status"] == 0).all()
    return {
        "rows": rows, "steps": ready.steps, "error of pilot rows [rad]": ready.pilot_error,
        "seconds": seconds, "of these to choose the steps": prepared_s,
        "seconds to read the files again": reading,
        "us a run": 1e6 * seconds / rows, "us a run, processor time": 1e6 * processor / rows,
        "files [MB]": size / 1e6,
        "largest memory [GB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }  # fmt: skip


def _arrays(study: SweepStudy, steps: int) -> tuple[Any, list[Any]]:
    """Sample and check all rows; return their batch, states, inputs and codes."""
    values = study.sampler.rows(0, study.rows)
    ready = prepare(study, steps)
    scenarios, _, _ = ready.scenarios(values)
    batch = ready.batch.with_parameters(scenarios)
    y, code = batch.start(study.scene.initial.gamma, (0.0, 0.0, 0.0))
    return batch, [y, batch.drives((0.0, 0.0, 0.0), study.rows), code]


def _ratios(steps: int) -> dict[str, float]:
    """Chunks, files included, against the compiled loop alone on prepared arrays, on all cores.

    Also in processor time, which a busy machine changes less.
    """
    study = study_of(CHUNKS * CHUNK)
    batch, (y, given, code) = _arrays(study, steps)
    times = []
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory() as folder:
            whole = _timed(partial(_chunks, study, steps, folder))
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


def _chunks(study: SweepStudy, steps: int, folder: str) -> None:
    """Compute and write all chunks of a study, on all cores."""
    task = ChunkTask(study, steps, folder, list_versions())
    run_local(task, range(study.chunks), lambda _: None, len(os.sched_getaffinity(0)))


def _timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of a call, and of all processors."""
    began, processor = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - began, time.process_time() - processor


def _mujoco(ours_us: float) -> dict[str, float]:
    """MuJoCo's `rollout` on as many threads, by the setting that is fastest to 1e-6 rad.

    The runs are alike: other inertias would not change its time.
    """
    from mujoco import rollout

    from benchmark.peers.mujoco_peer import Model
    from benchmark.peers.task import Task

    task, threads, copies = Task(), len(os.sched_getaffinity(0)), 8
    model = Model(task, "RK4", 0.01, 0.003, True)
    mujoco, kind = model.mujoco, model.mujoco.mjtState.mjSTATE_FULLPHYSICS
    model.reset(MUJOCO_STEPS)
    middles = (np.arange(MUJOCO_STEPS) + 0.5) / MUJOCO_STEPS
    controls = np.array([task.torque_at(t) for t in middles])[None].repeat(copies, axis=0)
    start = np.zeros(mujoco.mj_stateSize(model.model, kind))
    mujoco.mj_getState(model.model, model.data, start, kind)
    data = [mujoco.MjData(model.model) for _ in range(threads)]
    best = np.inf
    for _ in range(3):
        began = time.perf_counter()
        states, _ = rollout.rollout(
            model.model, data, start[None].repeat(copies, axis=0), controls, nstep=MUJOCO_STEPS
        )
        best = min(best, (time.perf_counter() - began) / copies)
    mujoco.mj_setState(model.model, model.data, states[0, -1], kind)
    reference = simulate(task.scene, t_eval=[1.0], tolerance=1e-12).quaternion[0]
    turn = rotation_matrix(reference).T @ model.pose().rotation
    error = float(np.linalg.norm(turn - np.eye(3)) / np.sqrt(2.0))
    return {
        "us a run, MuJoCo rollout": 1e6 * best,
        "error of MuJoCo [rad]": error,
        "MuJoCo rollout over the study": 1e6 * best / ours_us,
    }


def _cluster(steps: int) -> dict[str, float]:
    """Two workers of one thread against one; cost of a chunk and of the scheduler."""
    from sst_ros.sweeps.cluster_engine import connect, run_on_cluster, send_code

    found: dict[str, float] = {}
    study = study_of(CHUNKS * CHUNK)
    ready = prepare(study, steps)
    times: dict[str, list[float]] = {"1": [], "2": [], "C": []}
    with tempfile.TemporaryDirectory() as folder:
        task = ChunkTask(study, steps, folder, list_versions())
        began = time.perf_counter()
        run_chunk(task, 0)
        found["seconds of a chunk"] = time.perf_counter() - began
        with _workers(Path(folder), 2) as address, contextlib.closing(connect(address)) as client:
            client.wait_for_workers(2, timeout=60)
            send_code(client, ready.module)
            both = list(client.scheduler_info(n_workers=-1)["workers"])
            for index, worker in enumerate(both):  # each prepares the study once
                client.submit(_on_worker, task, index, workers=[worker], pure=False).result()
            for _ in range(ROUNDS):
                began = time.perf_counter()
                futures = [
                    client.submit(_on_worker, task, i, workers=[both[0]], pure=False)
                    for i in range(CHUNKS)
                ]
                client.gather(futures)
                times["1"].append(time.perf_counter() - began)
                began = time.perf_counter()
                run_on_cluster(client, task, range(CHUNKS), lambda _: None, print)
                times["2"].append(time.perf_counter() - began)
                times["C"].append(_bound())
            began = time.perf_counter()
            client.gather([client.submit(_nothing, i, pure=False) for i in range(1000)])
            found["seconds of an empty task, scheduler and client"] = (
                time.perf_counter() - began
            ) / 1000
    for workers in ("1", "2"):
        found[f"seconds of {CHUNKS} chunks, {workers} workers"] = min(times[workers])
    found["two workers against one"] = float(np.median(np.divide(times["1"], times["2"])))
    found["two loops in C against one, in turn with them"] = float(np.median(times["C"]))
    # The scheduler serves one task at a time: more threads than this wait for it.
    useful = found["seconds of a chunk"] / found["seconds of an empty task, scheduler and client"]
    found["largest useful number of threads"] = useful
    found["hours of 1e9 runs on them"] = (
        RUNS / CHUNK * found["seconds of an empty task, scheduler and client"] / 3600
    )
    return found


def _bound() -> float:
    """Throughput of two threads of bare C against one: what this machine gives to any program."""
    times = []
    for threads in (1, 2):
        began = time.perf_counter()
        with ThreadPoolExecutor(threads) as pool:
            list(
                pool.map(lambda _: hashlib.pbkdf2_hmac("sha256", b"", b"", HASHES), range(threads))
            )
        times.append(time.perf_counter() - began)
    return 2.0 * times[0] / times[1]


def _on_worker(task: ChunkTask, index: int) -> str:
    return run_chunk(task, index).status


def _nothing(index: int) -> int:
    return index


@contextlib.contextmanager
def _workers(folder: Path, count: int) -> Any:
    """Start a scheduler and workers of one thread; end them."""
    file = folder / "scheduler.json"
    options = ["--no-dashboard", "--scheduler-file", str(file)]
    words = [["dask_scheduler", "--port", "0", "--host", "127.0.0.1", *options]]
    words += [["dask_worker", "--nthreads", "1", "--no-nanny", *options]] * count
    processes = []
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    try:
        for name, *more in words:
            command = [sys.executable, "-m", f"distributed.cli.{name}", *more]
            null, code = subprocess.DEVNULL, Path(__file__).parents[1]
            process = subprocess.Popen(command, env=environment, stdout=null, stderr=null, cwd=code)
            processes.append(process)
            end = time.monotonic() + 60.0
            while not (file.exists() and file.stat().st_size):
                if time.monotonic() > end:
                    raise TimeoutError("no scheduler")
                time.sleep(0.05)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in processes:
            process.kill()
            process.wait(60)


if __name__ == "__main__":
    sys.exit(main())
