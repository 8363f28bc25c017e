# SPDX-License-Identifier: Apache-2.0
"""Many runs of a scene: chunks of a study on threads of this process, or on a Dask cluster.

A chunk depends on the study and its index alone, and its file appears whole: a chunk may be
computed again.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import check_kinds, refuse_unless, require
from sst_ros.host.many_runs import SweepFailed, run_many
from sst_ros.host.output import TEMPORARY, Bar, require_free, write_into
from sst_ros.scene.scene import scene_of
from sst_ros.sweeps.prepared import PreparedSweep
from sst_ros.sweeps.results import find_complete, read_sweep, to_frame, write_part
from sst_ros.sweeps.sweep_study import SweepStudy

if TYPE_CHECKING:
    import pandas as pd


@check_kinds
def sweep(
    scene: Any,
    vary: Any,
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
    fits = client is None or hasattr(client, "scheduler_info")
    named = not isinstance(vary, Iterable) or all(isinstance(key, str) for key in vary)
    refuse_unless("sweep", ("client", client, fits, "must be a dask.distributed Client"))
    refuse_unless("sweep", ("vary", vary, named, "must have keys of the scene, as text"))
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
    work, tables = partial(run_chunk, ready, out), dict[int, Any]()
    results = run_many(work, missing, workers=workers, client=client, name="chunk")
    try:
        for number, (early, table) in results:
            index = missing[number]
            tables[index] = table
            runs += len(study.rows_of(index))
            reasons.update(early)
            rate = max(runs / max(time.monotonic() - began, 1e-9), 1e-9)
            text = f"{rate:.0f} runs/s, {(total - runs) / rate:.0f} s left"
            if reasons:
                common = (f"{count} {reason}" for reason, count in reasons.most_common(3))
                text += f"; early: {', '.join(common)}"
            bar.draw(1.0 - (total - runs) / study.rows, text)
    except OSError as error:
        raise SweepFailed(f"{out}: {error}") from error
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
    write_part(table, out, index, ready.about)
    return counts, None
