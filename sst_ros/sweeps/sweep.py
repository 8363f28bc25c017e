# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene, on the cores of this machine or on a Dask cluster."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host.output import require_free, writing
from sst_ros.scene.scene import scene_of
from sst_ros.sweeps import parts
from sst_ros.sweeps.chunk_task import ChunkOutcome, ChunkTask, versions
from sst_ros.sweeps.local_engine import run_local
from sst_ros.sweeps.prepared import PreparedSweep, prepared
from sst_ros.sweeps.sweep_progress import SweepProgress
from sst_ros.sweeps.sweep_study import SweepStudy

if TYPE_CHECKING:
    import pandas as pd


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
            1.2, "relative"), "initial.gamma": ("normal", 0.785, 0.05)}; or a table (a mapping of
            columns, or a DataFrame) with a row for each run.
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
        options: `sampling`, `tolerance`, `steps`, `control`, `outputs`, `trajectory` and `chunk` of
            `SweepStudy`.

    Returns:
        Inputs, how each run ended (`status`, `reason`, `t`), `local_error`, and the outputs; units
        in `attrs`. With a trajectory in the study, `attrs["trajectory"]` is its table.

    Raises:
        InputError: an argument or a value in the study is not allowed; nothing has run then.
        SweepFailed: chunks could not be computed or written; those that are done remain.
        MissingDependency: dask, pandas, pyarrow or numba is not installed.

    """
    tabular = hasattr(vary, "columns")
    table = {str(name): vary[name].to_numpy(dtype=float) for name in vary} if tabular else None
    values = dict(options) | {
        "torque": torque, "duration": duration, "n": n, "seed": seed, "scene": scene_of(scene),
        "vary": {} if tabular else dict(vary),
    }  # fmt: skip
    if table is not None:
        values["table"] = table
    return run_study(
        SweepStudy.from_values(values),
        None if out is None else Path(out),
        client=client,
        workers=workers,
        resume=resume,
        progress=progress,
    )


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
    for module in ("dask", "pandas", "pyarrow"):
        require(module)
    if type(workers) is not int or not 0 <= workers <= 1024:
        allowed = "must be a whole number from 0 to 1024"
        raise InputError("sweep", [Problem("workers", workers, allowed)])
    if resume and out is None:
        raise InputError("sweep", [Problem("resume", True, "needs out")])
    if out is not None and not resume:
        require_free(out, "sweep")
    ready = prepared(study, _recorded_steps(out) if resume else None)
    _check_table(study, ready)
    done: set[int] = set()
    if out is not None:
        out = out.resolve()
        with writing(out, "sweep"):
            parts.clear_temporary(out)
            done = parts.complete(out, study, ready.steps)
            (out / "study.json").write_text(
                json.dumps(ready.about, indent=1) + "\n", encoding="utf-8"
            )
    bar = SweepProgress(study.rows, _rows(study, done), shown=progress)
    tables: dict[int, ChunkOutcome] = {}

    def take(outcome: ChunkOutcome) -> None:
        bar.add(outcome)
        if out is None:
            tables[outcome.index] = outcome

    task = ChunkTask(study, ready.steps, None if out is None else str(out), versions())
    missing = [index for index in range(study.chunks) if index not in done]
    if client is None:
        run_local(task, missing, take, workers or len(os.sched_getaffinity(0)))
    else:
        from sst_ros.sweeps.cluster_engine import run_on_cluster, send_code

        send_code(client, ready.module)
        run_on_cluster(client, task, missing, take, bar.note)
    if out is not None:
        return _read(out, study)
    return _joined(ready, tables)


def _recorded_steps(out: Path | None) -> int | None:
    """Return the number of steps of the study in a folder, chosen when it was started."""
    try:
        steps = json.loads((Path(out or ".") / "study.json").read_text(encoding="utf-8"))["steps"]
        return int(steps)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _check_table(study: SweepStudy, ready: PreparedSweep) -> None:
    """Refuse a table with rows that make no scene, before anything runs."""
    if study.table is not None:
        ready.check(study.sampler.rows(0, study.rows))


def _rows(study: SweepStudy, chunks: set[int]) -> int:
    return sum(min(study.chunk, study.rows - index * study.chunk) for index in chunks)


def _read(out: Path, study: SweepStudy) -> pd.DataFrame:
    frame = parts.read_sweep(out)
    if study.trajectory is not None:
        frame.attrs["trajectory"] = parts.read_sweep(out, "trajectory")
    return frame


def _joined(ready: PreparedSweep, outcomes: Mapping[int, ChunkOutcome]) -> pd.DataFrame:
    pyarrow = require("pyarrow")
    ordered = [outcomes[index] for index in sorted(outcomes)]
    frame = parts.framed(pyarrow.concat_tables([one.table for one in ordered]), ready.about)
    known = [one.trajectory for one in ordered if one.trajectory is not None]
    if known:
        frame.attrs["trajectory"] = parts.framed(pyarrow.concat_tables(known), ready.about)
    return frame
