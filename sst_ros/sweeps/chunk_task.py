# SPDX-License-Identifier: Apache-2.0
"""Chunks of a study: computed and written by a thread or a worker, read as one table, summed up.

Results are Parquet files, one a chunk, each complete or absent: a file is written to a temporary
name, flushed to the disk, and renamed. Its metadata holds the study, its digest, the version and
the units, so that a file explains itself and `--resume` knows which chunks are there.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sst_ros.errors import InputError, Problem, SstError
from sst_ros.extras import require
from sst_ros.host.output import TEMPORARY, replace_file
from sst_ros.sweeps.prepared import prepare
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


METADATA = b"sst_ros"


class SweepFailed(SstError):
    """Chunks of a study could not be computed or written; the others are complete."""


@dataclass(frozen=True)
class ChunkTask:
    """What all chunks of a study have in common.

    Attributes:
        study: what runs.
        steps: number of steps of a run.
        folder: where files are written; None to return tables.
        versions: those of the process that started the study, see `list_versions`.

    """

    study: SweepStudy
    steps: int
    folder: Path | None
    versions: Mapping[str, str]


@dataclass(frozen=True)
class ChunkOutcome:
    """The outcome of a chunk.

    Attributes:
        index: of the chunk.
        worker: its address.
        fault: why this worker can compute no chunk, or write none; empty where it is done.
        reasons: how runs ended, and how many; without those that reached the end.
        table: the results, where no file is written.
        trajectory: states over time, where no file is written.

    """

    index: int
    worker: str
    fault: str = ""
    reasons: Mapping[str, int] = field(default_factory=dict)
    table: pa.Table | None = None
    trajectory: pa.Table | None = None


def list_versions() -> dict[str, str]:
    """Versions on which the bits of results depend."""
    import numba
    import scipy

    return {
        "sst_ros": VERSION,
        "python": ".".join(platform.python_version_tuple()[:2]),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
    }


def difference(expected: Mapping[str, str]) -> str:
    """How this process differs from the versions expected; empty where it does not."""
    here = list_versions()
    return ", ".join(
        f"{name} {here.get(name, 'missing')} in place of {version}"
        for name, version in expected.items()
        if here.get(name) != version
    )


def run_chunk(task: ChunkTask, index: int, worker: str = "") -> ChunkOutcome:
    """Compute a chunk and write its file; a fault of this machine is an outcome, not an error."""
    folder = task.folder
    if differs := difference(task.versions):
        return ChunkOutcome(index, worker, f"this worker has {differs}")
    if folder is not None and not folder.is_dir():
        needed = f"{folder} is not there: workers need the folder of --out on a shared disk"
        return ChunkOutcome(index, worker, needed)
    ready = prepare(task.study, task.steps)
    table, trajectory = ready.chunk(index)
    counts = {row["values"]: row["counts"] for row in table["reason"].value_counts().to_pylist()}
    counts.pop("reached the end", None)
    if folder is None:
        return ChunkOutcome(index, worker, "", counts, table, trajectory)
    try:
        if trajectory is not None:
            write(trajectory, folder, part(index, "trajectory"), ready.about)
        write(table, folder, part(index), ready.about)
    except OSError as error:
        return ChunkOutcome(index, worker, f"{folder}: {error}")
    return ChunkOutcome(index, worker, "", counts)


def run_local(
    task: ChunkTask, chunks: Sequence[int], done: Callable[[ChunkOutcome], None], workers: int
) -> None:
    """Compute chunks on threads; the compiled code releases the interpreter's lock.

    Args:
        task: what all chunks have in common.
        chunks: indices of the chunks.
        done: is called with each outcome, by this thread.
        workers: number of threads.

    Raises:
        SweepFailed: a file cannot be written.

    """
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(run_chunk, task, index) for index in chunks]
        try:
            for future in as_completed(futures):
                outcome = future.result()
                if outcome.fault:
                    raise SweepFailed(f"chunk {outcome.index}: {outcome.fault}")
                done(outcome)
        finally:
            pool.shutdown(cancel_futures=True)


def part(index: int, kind: str = "part") -> str:
    """Name of the file of a chunk."""
    return f"{kind}-{index:07d}.parquet"


def write(table: pa.Table, folder: Path, name: str, about: Mapping[str, Any]) -> None:
    """Write a table as a file that is there whole or not at all.

    Raises:
        OSError: it cannot be written; nothing of it is left.

    """
    parquet = require("pyarrow.parquet")
    names = set(table.column_names)
    units = {name: unit for name, unit in about["units"].items() if name in names}
    about = dict(about) | {"units": units}
    table = table.replace_schema_metadata({METADATA: json.dumps(about).encode()})
    with replace_file(folder / name) as own:
        # Random mantissas do not compress, and their least and greatest help no reader.
        parquet.write_table(
            table, own, compression="none", use_dictionary=["reason"], write_statistics=False
        )
        own.chmod(0o644)


def read_about(path: Path) -> dict[str, Any] | None:
    """Metadata of a file, with its number of rows; None if it is no complete file of a study."""
    parquet = require("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            found: dict[str, Any] = json.loads(file.schema_arrow.metadata[METADATA])
            return found | {"rows": file.metadata.num_rows}
    except (OSError, ValueError, KeyError, TypeError, require("pyarrow").ArrowException):
        return None


def find_complete(folder: Path, study: SweepStudy, steps: int) -> set[int]:
    """Return the chunks whose files are there.

    Raises:
        InputError: a file is that of another study or version.

    """
    expected = {"digest": study.digest, "steps": steps, "version": VERSION}
    found = set()
    for path in sorted(folder.glob("part-*.parquet")):
        about = read_about(path)
        if about is None:
            continue
        if any(about[key] != value for key, value in expected.items()):
            allowed = "is of another study or version: choose another --out"
            raise InputError("sweep", [Problem("--resume", str(path), allowed)])
        index = int(path.stem.removeprefix("part-"))
        rows, trajectory = study.rows_of(index), folder / part(index, "trajectory")
        kept = study.trajectory is not None and rows.start < study.trajectory["rows"]
        if about["rows"] == len(rows) and (not kept or read_about(trajectory) is not None):
            found.add(index)
    return found


def clear_temporary(folder: Path) -> None:
    """Remove what killed processes have left."""
    for path in folder.glob(f"{TEMPORARY}*"):
        path.unlink(missing_ok=True)


def read_sweep(folder: Path, kind: str = "part") -> pd.DataFrame:
    """Read the results in a folder as one table, units and study in its `attrs`.

    Raises:
        InputError: there are none.

    """
    paths = sorted(folder.glob(f"{kind}-*.parquet"))
    about = next(filter(None, map(read_about, paths)), None)
    if about is None:
        allowed = f"must be a folder with files {kind}-*.parquet of `sst-ros sweep`"
        raise InputError("sweep", [Problem("DIR", str(folder), allowed)])
    return to_frame(require("pyarrow.parquet").read_table(list(map(str, paths))), about)


def to_frame(table: pa.Table, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return a table as pandas, with its metadata as `attrs`."""
    frame: pd.DataFrame = table.replace_schema_metadata(None).to_pandas()
    if "t" in frame and "status" in frame:
        frame = frame.set_index("scenario")
    frame.attrs = {key: value for key, value in about.items() if key != "rows"}
    return frame


SHOWN = 8
NOT_OUTPUTS = ("status", "reason", "t", "fault_time", "local_error")


def summarize(table: pd.DataFrame) -> str:
    """Return a text of the table of a study."""
    counts = table["reason"].value_counts()
    steps, length = table.attrs["steps"], table.attrs["duration"]
    lines = [f"{len(table)} runs of {length:g} s, {steps} steps each"]
    lines += [f"  {count:>10}  {reason}" for reason, count in counts.items() if count]
    causes = correlate(table)
    if len(causes):
        lines.append("Rank correlation of inputs with an early end:")
        lines += [f"  {value:>10.3f}  {name}" for name, value in causes.head(SHOWN).items()]
    outputs = table.loc[table["status"] == 0, list_outputs(table)]
    if len(outputs):
        shown = outputs.describe(percentiles=[0.01, 0.99]).T[["mean", "std", "1%", "99%"]]
        shown["unit"] = [table.attrs["units"].get(name, "") for name in shown.index]
        lines.append(shown.to_string(float_format="{:.6g}".format))
    return "\n".join(lines)


def list_outputs(table: pd.DataFrame) -> list[str]:
    """Names of the outputs of a study."""
    known = (*table.attrs["inputs"], *NOT_OUTPUTS)
    return [name for name in table.columns if name not in known]


def correlate(table: pd.DataFrame, column: pd.Series | None = None) -> pd.Series:
    """Spearman's rank correlation of each input with a column, largest first; none if constant.

    The column is by default whether a run ended early.
    """
    column = (table["status"] != 0).astype(float) if column is None else column
    inputs = [name for name in table.attrs["inputs"] if table[name].nunique() > 1]
    if column.nunique() < 2 or not inputs:
        return table[[]].sum()
    found = table[inputs].corrwith(column, method="spearman")
    return found.sort_values(key=abs, ascending=False)
