# SPDX-License-Identifier: Apache-2.0
"""A recorded run as pandas tables, CSV or Parquet, to the bits of the recording.

Times are whole nanoseconds, all else doubles; what was lost is empty. Columns bear their units;
`topic_tables.TABLES` describes each.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sst_ros.extras import require
from sst_ros.host.output import require_free, write_into
from sst_ros.recording import signals

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
    return signals.read(Path(bag)).table(table)


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
            table = run.table(name)
            if form == "csv":
                # pandas writes the fewest digits that read back as the same bits.
                table.to_csv(paths[-1], lineterminator="\n")
                continue
            pyarrow, parquet = require("pyarrow"), require("pyarrow.parquet")
            arrow = pyarrow.Table.from_pandas(table.reset_index(), preserve_index=False)
            fields = [
                arrow.schema.field(column.name).with_metadata(
                    {"unit": column.unit, "description": column.text}
                )
                for column in run.columns(name)
            ]
            parquet.write_table(arrow.cast(pyarrow.schema(fields)), paths[-1])
    return paths
