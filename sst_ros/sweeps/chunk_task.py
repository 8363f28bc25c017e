# SPDX-License-Identifier: Apache-2.0
"""The task that a thread or a worker does: one chunk, computed and written."""

from __future__ import annotations

import platform
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.sweeps import parts
from sst_ros.sweeps.prepared import prepared
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pyarrow as pa

DONE, REFUSED, UNWRITABLE = "done", "refused", "unwritable"


@dataclass(frozen=True)
class ChunkTask:
    """What all chunks of a study have in common.

    Attributes:
        study: what runs.
        steps: number of steps of a run.
        folder: where files are written; None to return tables.
        versions: those of the process that started the study, see `versions`.

    """

    study: SweepStudy
    steps: int
    folder: str | None
    versions: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class ChunkOutcome:
    """The outcome of a chunk.

    Attributes:
        index: of the chunk.
        status: DONE, REFUSED by a worker of another version, or UNWRITABLE.
        detail: the reason, where it is not done.
        rows: number of rows.
        reasons: how runs ended, and how many; without those that reached the end.
        table: the results, where no file is written.
        trajectory: states over time, where no file is written.
        worker: address of the worker.

    """

    index: int
    status: str
    detail: str = ""
    rows: int = 0
    reasons: tuple[tuple[str, int], ...] = ()
    table: pa.Table | None = None
    trajectory: pa.Table | None = None
    worker: str = ""


def versions() -> tuple[tuple[str, str], ...]:
    """Versions on which the bits of results depend."""
    import numba
    import scipy

    return (
        ("sst_ros", VERSION),
        ("python", ".".join(platform.python_version_tuple()[:2])),
        ("numpy", np.__version__),
        ("scipy", scipy.__version__),
        ("numba", numba.__version__),
    )


def difference(expected: tuple[tuple[str, str], ...]) -> str:
    """How this process differs from the versions expected; empty where it does not."""
    here = dict(versions())
    texts = [
        f"{name} {here.get(name, 'missing')} in place of {version}"
        for name, version in expected
        if here.get(name) != version
    ]
    return ", ".join(texts)


def run_chunk(task: ChunkTask, index: int, worker: str = "") -> ChunkOutcome:
    """Compute a chunk and write its file; a fault of this machine is an outcome, not an error."""
    if differs := difference(task.versions):
        return ChunkOutcome(index, REFUSED, f"this worker has {differs}", worker=worker)
    folder = None if task.folder is None else Path(task.folder)
    if folder is not None and not folder.is_dir():
        allowed = f"{folder} is not there: workers need the folder of --out on a shared disk"
        return ChunkOutcome(index, UNWRITABLE, allowed, worker=worker)
    ready = prepared(task.study, task.steps)
    table, trajectory = ready.chunk(index)
    counts = Counter(
        {row["values"]: row["counts"] for row in table["reason"].value_counts().to_pylist()}
    )
    counts.pop("reached the end", None)
    outcome = ChunkOutcome(
        index, DONE, rows=len(table), reasons=tuple(counts.items()), worker=worker
    )
    if folder is None:
        return ChunkOutcome(**vars(outcome) | {"table": table, "trajectory": trajectory})
    try:
        if trajectory is not None:
            parts.write(trajectory, folder, parts.part(index, "trajectory"), ready.about)
        parts.write(table, folder, parts.part(index), ready.about)
    except OSError as error:
        return ChunkOutcome(index, UNWRITABLE, f"{folder}: {error}", worker=worker)
    return outcome
