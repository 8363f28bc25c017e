# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene, on the cores of this machine or on a Dask cluster."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import refuse_unless, require
from sst_ros.host.output import TEMPORARY, Bar, require_free, write_into
from sst_ros.scene.scene import scene_of
from sst_ros.sweeps.engine import ChunkOutcome, run_chunk, run_local, run_on_cluster
from sst_ros.sweeps.prepared import prepare
from sst_ros.sweeps.results import find_complete, read_sweep, to_frame
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
        MissingDependency: pandas, pyarrow or numba is not installed.

    """
    rows = {"table": vary} if hasattr(vary, "columns") else {"vary": dict(vary)}
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
    steps = None
    if out is not None:
        out = out.resolve()
        if resume:  # with the number of steps that was chosen when it was started
            with suppress(OSError, ValueError, KeyError, TypeError):
                steps = int(json.loads((out / "study.json").read_text(encoding="utf-8"))["steps"])
        else:
            require_free(out, "sweep")
    ready = prepare(study, steps)
    if study.table is not None:  # refuse rows that make no scene, before anything runs
        ready.check(study.draw(0, study.rows))
    complete: set[int] = set()
    if out is not None:
        with write_into(out, "sweep"):
            for left in out.glob(f"{TEMPORARY}*"):  # by killed processes
                left.unlink(missing_ok=True)
            complete = find_complete(out, study, ready.steps)
            text = json.dumps(ready.about, indent=1) + "\n"
            (out / "study.json").write_text(text, encoding="utf-8")
    missing = [index for index in range(study.chunks) if index not in complete]
    total = sum(len(study.rows_of(index)) for index in missing)
    bar, began, reasons, runs = Bar("sweep", progress), time.monotonic(), Counter[str](), 0
    tables: dict[int, Any] = {}

    def done(outcome: ChunkOutcome) -> None:
        """Keep a chunk, and show the runs that are done and how the early ones ended."""
        nonlocal runs
        runs += len(study.rows_of(outcome.index))
        reasons.update(outcome.reasons)
        tables[outcome.index] = outcome.tables
        rate = max(runs / max(time.monotonic() - began, 1e-9), 1e-9)
        text = f"{rate:.0f} runs/s, {(total - runs) / rate:.0f} s left"
        if reasons:
            common = (f"{count} {reason}" for reason, count in reasons.most_common(3))
            text += f"; early: {', '.join(common)}"
        bar.draw(1.0 - (total - runs) / study.rows, text)

    compute = partial(run_chunk, study, ready.steps, out)
    if client is None:
        run_local(compute, missing, done, workers or len(os.sched_getaffinity(0)))
    else:
        run_on_cluster(client, compute, missing, done)

    def read(kind: int) -> pd.DataFrame:
        if out is not None:
            return read_sweep(out, ("part", "trajectory")[kind])
        parts = (tables[index][kind] for index in range(study.chunks))
        whole = require("pyarrow").concat_tables(part for part in parts if part is not None)
        return to_frame(whole, ready.about)

    frame = read(0)
    if study.trajectory is not None:
        frame.attrs["trajectory"] = read(1)
    return frame
