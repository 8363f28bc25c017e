# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene, on the cores of this machine or on a Dask cluster."""

from __future__ import annotations

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host.output import Bar, require_free, write_into
from sst_ros.scene.scene import scene_of
from sst_ros.sweeps.chunk_task import (
    ChunkOutcome,
    ChunkTask,
    clear_temporary,
    find_complete,
    list_versions,
    read_sweep,
    run_local,
    to_frame,
)
from sst_ros.sweeps.prepared import PreparedSweep, prepare
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
    values = dict(
        options,
        torque=torque,
        duration=duration,
        n=n,
        seed=seed,
        scene=scene_of(scene),
        vary={} if tabular else dict(vary),
    )
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
    ready = prepare(study, _read_steps(out) if resume else None)
    if study.table is not None:  # refuse rows that make no scene, before anything runs
        ready.check(study.sampler.rows(0, study.rows))
    done: set[int] = set()
    if out is not None:
        out = out.resolve()
        with write_into(out, "sweep"):
            clear_temporary(out)
            done = find_complete(out, study, ready.steps)
            (out / "study.json").write_text(
                json.dumps(ready.about, indent=1) + "\n", encoding="utf-8"
            )
    before = sum(min(study.chunk, study.rows - index * study.chunk) for index in done)
    bar = SweepProgress(study.rows, before, shown=progress)
    tables: dict[int, ChunkOutcome] = {}

    def take(outcome: ChunkOutcome) -> None:
        bar.add(outcome)
        if out is None:
            tables[outcome.index] = outcome

    task = ChunkTask(study, ready.steps, None if out is None else str(out), list_versions())
    missing = [index for index in range(study.chunks) if index not in done]
    if client is None:
        run_local(task, missing, take, workers or len(os.sched_getaffinity(0)))
    else:
        from sst_ros.sweeps.cluster_engine import run_on_cluster, send_code

        send_code(client, ready.module)
        run_on_cluster(client, task, missing, take, bar.note)
    if out is None:
        return _join(ready, tables)
    frame = read_sweep(out)
    if study.trajectory is not None:
        frame.attrs["trajectory"] = read_sweep(out, "trajectory")
    return frame


def _read_steps(out: Path | None) -> int | None:
    """Return the number of steps of the study in a folder, chosen when it was started."""
    try:
        steps = json.loads((Path(out or ".") / "study.json").read_text(encoding="utf-8"))["steps"]
        return int(steps)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _join(ready: PreparedSweep, outcomes: Mapping[int, ChunkOutcome]) -> pd.DataFrame:
    pyarrow = require("pyarrow")
    ordered = [outcomes[index] for index in sorted(outcomes)]
    frame = to_frame(pyarrow.concat_tables([one.table for one in ordered]), ready.about)
    known = [one.trajectory for one in ordered if one.trajectory is not None]
    if known:
        frame.attrs["trajectory"] = to_frame(pyarrow.concat_tables(known), ready.about)
    return frame


class SweepProgress:
    """A bar with the runs that are done and how the early ones ended.

    Args:
        total: rows of the study.
        done: rows that are there already.
        shown: draw it, if stderr is a terminal.

    """

    def __init__(self, total: int, done: int, *, shown: bool) -> None:
        self._total, self._before, self._done = total, done, done
        self._bar, self._began = Bar("sweep", shown), time.monotonic()
        self._reasons: Counter[str] = Counter()

    def add(self, outcome: ChunkOutcome) -> None:
        """Count a chunk that is done."""
        self._done += outcome.rows
        self._reasons.update(dict(outcome.reasons))
        rate = (self._done - self._before) / max(time.monotonic() - self._began, 1e-9)
        ended = ", ".join(f"{count} {text}" for text, count in self._reasons.most_common(3))
        left = f"{rate:.0f} runs/s, {(self._total - self._done) / max(rate, 1e-9):.0f} s left"
        self._bar.draw(self._done / self._total, left + (f"; early: {ended}" if ended else ""))

    def note(self, text: str) -> None:
        """Print a message."""
        print(f"sweep: {text}", file=sys.stderr, flush=True)
