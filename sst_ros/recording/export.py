# SPDX-License-Identifier: Apache-2.0
"""A recorded run as CSV, Parquet or pandas, to the bits of the bag.

Times are whole nanoseconds, all else doubles, written so that reading them gives the same bits;
what was lost is empty. Columns bear their units; `contents.TABLES` says what each is.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sst_ros.errors import InputError, Problem
from sst_ros.output_folder import writing
from sst_ros.progress import slices
from sst_ros.recording import signals
from sst_ros.recording.signals import Signals
from sst_ros.recording.topic_tables import TIMES, Column

if TYPE_CHECKING:
    import pandas as pandas_

FORMATS = ("csv", "parquet")
_BLOCK = 10_000

Values = NDArray[Any]
Columns = list[tuple[Column, Values]]


def frame(bag: str | Path, table: str = "samples") -> pandas_.DataFrame:
    """Read a table of a bag for a notebook.

    Args:
        bag: a rosbag2 recording, MCAP or sqlite3.
        table: samples, ticks, commands, commands_stamped or external_moment.

    Returns:
        A row for each stamp, indexed by `time_ns` [ns] since the start of the run; columns bear
        their units, and `attrs` says what each is.

    Raises:
        InputError: the bag cannot be read, it has no such table, or there is no pandas.

    """
    pandas = _library("pandas")
    run = signals.read(Path(bag))
    if table not in run.tables:
        allowed = "must be one of those in the bag: " + ", ".join(run.tables)
        raise InputError(str(bag), [Problem("table", table, allowed)])
    columns = _columns(run, table)
    data = {column.name: values for column, values in columns}
    result: pandas_.DataFrame = pandas.DataFrame(data).set_index(TIMES[0].name)
    result.attrs = {column.name: said(column) for column, _ in columns}
    return result


def export(bag: Path, out: Path, form: str = FORMATS[0]) -> list[Path]:
    """Write a file for each table of a bag into the folder `out`; return their paths.

    Raises:
        InputError: the bag cannot be read, `out` cannot be written, or there is no pyarrow.

    """
    write = {"csv": _csv, "parquet": _parquet}[form]
    run = signals.read(bag)
    with writing(out, "export"):
        paths = []
        for name in run.tables:
            paths.append(out / f"{name}.{form}")
            write(paths[-1], _columns(run, name))
    return paths


def said(column: Column) -> str:
    """Describe a column: what it is, its unit, its topic."""
    words = [column.what, f"[{column.unit}]"]
    return " ".join(words) + (f", from {column.topic}" if column.topic else "")


def _columns(run: Signals, table: str) -> Columns:
    """Give all columns of a table: those in nanoseconds whole, the others as doubles."""
    series = run.tables[table]
    times = (run.time_ns(table), series.stamp_ns, series.received_ns)
    numbers = [
        values.astype(np.int64) if column.unit == "ns" else values
        for column, values in zip(series.columns, series.values.T, strict=True)
    ]
    return list(zip((*TIMES, *series.columns), (*times, *numbers), strict=True))


def _csv(path: Path, columns: Columns) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(column.name for column, _ in columns) + "\n")
        for block in slices(len(columns[0][1]), _BLOCK, "rows", True):
            texts = [_texts(values[block]) for _, values in columns]
            file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))


def _texts(values: Values) -> list[str]:
    """Write numbers with the fewest digits that read back as the same bits; nan is empty."""
    return ["" if number != number else repr(number) for number in values.tolist()]


def _parquet(path: Path, columns: Columns) -> None:
    pyarrow, parquet = _library("pyarrow"), _library("pyarrow.parquet")
    fields = [
        pyarrow.field(
            column.name,
            pyarrow.int64() if column.unit == "ns" else pyarrow.float64(),
            metadata={"unit": column.unit, "description": said(column)},
        )
        for column, _ in columns
    ]
    arrays = [pyarrow.array(values) for _, values in columns]
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields)), path)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        allowed = "is not installed; pip install 'sst_ros[export]', or use CSV"
        raise InputError("export", [Problem(name.partition(".")[0], None, allowed)]) from None
