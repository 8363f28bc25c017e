# SPDX-License-Identifier: Apache-2.0
"""A recorded run as pandas tables, CSV or Parquet, to the bits of the recording.

Times are whole nanoseconds, all else doubles; what was lost is empty. Columns bear their units;
`topic_tables.TABLES` describes each.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sst_ros.errors import InputError, Problem
from sst_ros.extras import require
from sst_ros.host.output import require_free, write_into
from sst_ros.recording import signals
from sst_ros.recording.signals import Signals
from sst_ros.recording.topic_tables import TIMES, Column

if TYPE_CHECKING:
    import pandas as pd

FORMATS = ("csv", "parquet")


def frame(bag: str | Path, table: str = "samples") -> pd.DataFrame:
    """Read a table of a recording.

    Args:
        bag: a rosbag2 recording, MCAP or sqlite3.
        table: samples, ticks, commands, commands_stamped or external_moment.

    Returns:
        A row for each stamp, indexed by `time_ns` [ns] since the start of the run; columns bear
        their units, and `attrs` describes each.

    Raises:
        InputError: the recording cannot be read, or it has no such table.
        MissingDependency: pandas is not installed.

    """
    return table_of(signals.read(Path(bag)), table)


def table_of(run: Signals, table: str = "samples") -> pd.DataFrame:
    """Return a table of a recording that was read, as `frame` does.

    Raises:
        InputError: it has no such table.
        MissingDependency: pandas is not installed.

    """
    pandas = require("pandas")
    if table not in run.tables:
        allowed = "must be one of those in the bag: " + ", ".join(run.tables)
        raise InputError(str(run.path), [Problem("table", table, allowed)])
    series = run.tables[table]
    times = (run.time_ns(table), series.stamp_ns, series.received_ns)
    data = {column.name: values for column, values in zip(TIMES, times, strict=True)}
    for column, values in zip(series.columns, series.values.T, strict=True):
        data[column.name] = values.astype(np.int64) if column.unit == "ns" else values
    result: pd.DataFrame = pandas.DataFrame(data).set_index(TIMES[0].name)
    result.attrs = {column.name: column.text for column in _columns(run, table)}
    return result


def export(bag: Path, out: Path, form: str = FORMATS[0], *, force: bool = False) -> list[Path]:
    """Write a file for each table of a recording into the folder `out`; return their paths.

    Args:
        bag: a rosbag2 recording, MCAP or sqlite3.
        out: folder, made if it is not there.
        form: csv or parquet.
        force: replace earlier files.

    Raises:
        InputError: the recording cannot be read, `out` cannot be written or is not empty.
        MissingDependency: pandas or pyarrow is not installed.

    """
    require_free(out, "export", force=force)
    run = signals.read(bag)
    with write_into(out, "export"):
        paths = []
        for name in run.tables:
            paths.append(out / f"{name}.{form}")
            table = table_of(run, name)
            if form == "csv":
                # pandas writes the fewest digits that read back as the same bits.
                table.to_csv(paths[-1], lineterminator="\n")
            else:
                _write_parquet(paths[-1], table, _columns(run, name))
    return paths


def _columns(run: Signals, table: str) -> tuple[Column, ...]:
    return (*TIMES, *run.tables[table].columns)


def _write_parquet(path: Path, table: pd.DataFrame, columns: tuple[Column, ...]) -> None:
    pyarrow, parquet = require("pyarrow"), require("pyarrow.parquet")
    arrow = pyarrow.Table.from_pandas(table.reset_index(), preserve_index=False)
    fields = [
        arrow.schema.field(column.name).with_metadata(
            {"unit": column.unit, "description": column.text}
        )
        for column in columns
    ]
    parquet.write_table(arrow.cast(pyarrow.schema(fields)), path)
