# SPDX-License-Identifier: Apache-2.0
"""Results of a study as Parquet files, one a chunk, each complete or absent.

A file is written to a temporary name, flushed to the disk, and renamed. Its metadata holds the
study, its digest, the version and the units, so that a file explains itself and `--resume` knows
which chunks are there.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

METADATA = b"sst_ros"
_TEMPORARY = ".part-"


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
    handle, temporary = tempfile.mkstemp(prefix=_TEMPORARY, dir=folder)
    try:
        # Random mantissas do not compress, and their least and greatest help no reader.
        parquet.write_table(
            table, temporary, compression="none", use_dictionary=["reason"], write_statistics=False
        )
        os.fsync(handle)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(folder / name)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    finally:
        os.close(handle)


def about_of(path: Path) -> dict[str, Any] | None:
    """Metadata of a file, with its number of rows; None if it is no complete file of a study."""
    parquet = require("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            found: dict[str, Any] = json.loads(file.schema_arrow.metadata[METADATA])
            return found | {"rows": file.metadata.num_rows}
    except (OSError, ValueError, KeyError, TypeError, require("pyarrow").ArrowException):
        return None


def complete(folder: Path, study: SweepStudy, steps: int) -> set[int]:
    """Return the chunks whose files are there.

    Raises:
        InputError: a file is that of another study or version.

    """
    expected = {"digest": study.digest, "steps": steps, "version": VERSION}
    found = set()
    for path in sorted(folder.glob("part-*.parquet")):
        about = about_of(path)
        if about is None:
            continue
        if any(about[key] != value for key, value in expected.items()):
            allowed = "is of another study or version: choose another --out"
            raise InputError("sweep", [Problem("--resume", str(path), allowed)])
        index = int(path.stem.removeprefix("part-"))
        rows = min(study.chunk, study.rows - index * study.chunk)
        trajectory = folder / part(index, "trajectory")
        wanted = study.trajectory is not None and index * study.chunk < study.trajectory["rows"]
        if about["rows"] == rows and (not wanted or about_of(trajectory) is not None):
            found.add(index)
    return found


def clear_temporary(folder: Path) -> None:
    """Remove what killed processes have left."""
    for path in folder.glob(f"{_TEMPORARY}*"):
        path.unlink(missing_ok=True)


def read_sweep(folder: Path, kind: str = "part") -> pd.DataFrame:
    """Read the results in a folder as one table, units and study in its `attrs`.

    Raises:
        InputError: there are none.

    """
    paths = sorted(folder.glob(f"{kind}-*.parquet"))
    about = [one for one in map(about_of, paths) if one is not None]
    if not about:
        allowed = f"must be a folder with files {kind}-*.parquet of `sst-ros sweep`"
        raise InputError("sweep", [Problem("DIR", str(folder), allowed)])
    dataset = require("pyarrow.parquet").read_table([str(path) for path in paths])
    return framed(dataset, about[0])


def framed(table: pa.Table, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return a table as pandas, with its metadata as `attrs`."""
    frame: pd.DataFrame = table.replace_schema_metadata(None).to_pandas()
    if "t" in frame and "status" in frame:
        frame = frame.set_index("scenario")
    frame.attrs = {key: value for key, value in about.items() if key != "rows"}
    return frame
