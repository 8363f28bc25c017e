# SPDX-License-Identifier: Apache-2.0
"""Results of a study: a file for each chunk, all of them as one table, and what it shows.

A Parquet file is complete or absent. Its metadata holds the study, its digest, the version and the
units, so that a file explains itself and `--resume` knows which chunks are there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.errors import refusal, refuse_unless, require
from sst_ros.host.output import replace_file
from sst_ros.report.results import render
from sst_ros.sweeps.sweep_study import SweepStudy
from sst_ros.version import VERSION

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

METADATA = b"sst_ros"
_SHOWN = 8  # causes of early ends in a summary
_NOT_OUTPUTS = ("status", "reason", "t", "fault_time", "local_error")


def write_part(table: pa.Table, folder: Path, index: int, about: Mapping[str, Any]) -> None:
    """Write the table of a chunk as a file that is there whole or not at all."""
    table = table.replace_schema_metadata({METADATA: json.dumps(about).encode()})
    with replace_file(folder / f"part-{index:07d}.parquet") as own:
        # Random mantissas do not compress, and their least and greatest help no reader.
        require("pyarrow.parquet").write_table(
            table, own, compression="none", use_dictionary=["reason"], write_statistics=False
        )
        own.chmod(0o644)


def read_about(path: Path) -> dict[str, Any] | None:
    """Metadata of a file, with its number of rows; None if it is no complete file of a study."""
    try:
        with require("pyarrow.parquet").ParquetFile(path) as file:
            found: dict[str, Any] = json.loads(file.schema_arrow.metadata[METADATA])
            return found | {"rows": file.metadata.num_rows}
    except (OSError, ValueError, KeyError, TypeError, require("pyarrow").ArrowException):
        return None


def find_complete(folder: Path, study: SweepStudy) -> tuple[set[int], int | None]:
    """Return the chunks whose files are there, and the number of steps of their runs.

    Raises InputError at a file of another study or version.
    """
    expected: dict[str, Any] = {"digest": study.digest, "version": VERSION}
    found = set()
    for path in sorted(folder.glob("part-*.parquet")):
        about = read_about(path)
        if about is None:
            continue
        same = all(about[key] == value for key, value in expected.items())
        allowed = "is of another study or version: choose another --out"
        refuse_unless("sweep", ("--resume", str(path), same, allowed))
        expected["steps"] = about["steps"]
        index = int(path.stem.removeprefix("part-"))
        if about["rows"] == len(study.rows_of(index)):
            found.add(index)
    return found, expected.get("steps")


def read_sweep(folder: Path) -> pd.DataFrame:
    """Read the results in a folder as one table, units and study in its `attrs`, or refuse it."""
    paths = sorted(folder.glob("part-*.parquet"))
    about = next(filter(None, map(read_about, paths)), None)
    if about is None:
        allowed = "must be a folder with files part-*.parquet of `sst-ros sweep`"
        raise refusal("sweep", "DIR", str(folder), allowed)
    return to_frame(require("pyarrow.parquet").read_table(list(map(str, paths))), about)


def to_frame(table: pa.Table, about: Mapping[str, Any]) -> pd.DataFrame:
    """Return a table as pandas, with its metadata as `attrs`."""
    frame: pd.DataFrame = table.replace_schema_metadata(None).to_pandas().set_index("scenario")
    frame.attrs = {key: value for key, value in about.items() if key != "rows"}
    return frame


def summarize(table: pd.DataFrame) -> str:
    """Return a text of the table of a study."""
    outputs = table.loc[table["status"] == 0, list_outputs(table)]
    shown = outputs.describe(percentiles=[0.01, 0.99]).T[["mean", "std", "1%", "99%"]]
    shown["unit"] = [table.attrs["units"].get(name, "") for name in shown.index]
    return render(
        "sweep.txt",
        runs=len(table),
        about=table.attrs,
        reasons=table["reason"].value_counts(),
        causes=correlate(table).head(_SHOWN).to_dict(),
        outputs=shown.to_string(float_format="{:.6g}".format) if len(outputs) else "",
    )


def list_outputs(table: pd.DataFrame) -> list[str]:
    """Names of the outputs of a study."""
    known = (*table.attrs["inputs"], *_NOT_OUTPUTS)
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
