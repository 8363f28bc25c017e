# SPDX-License-Identifier: Apache-2.0
"""Results of a study in files: tables by pandas, a page of Markdown, figures."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sst_ros.extras import require
from sst_ros.host.output import writing
from sst_ros.plot.style import save_figure
from sst_ros.report.summary import made_on
from sst_ros.report.text import made_line

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


def table(rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None) -> DataFrame:
    """Return a DataFrame of rows; what is unknown stays None.

    Raises:
        MissingDependency: pandas is not installed.

    """
    listed = list(rows)
    names = None if columns is None else list(columns)
    frame: DataFrame = require("pandas").DataFrame(listed, columns=names)
    for name in frame.columns:  # whole numbers with gaps stay whole numbers
        values = [row.get(name) for row in listed]
        if None in values and all(type(value) is int for value in values if value is not None):
            frame[name] = frame[name].astype("Int64")
    return frame


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as JSON has them: None for what is unknown."""
    return list(frame.astype(object).where(frame.notna(), None).to_dict("records"))


def markdown(frame: DataFrame) -> str:
    """Return a table of texts as Markdown."""
    lines = ["| " + " | ".join(map(str, frame.columns)) + " |", "| --- " * len(frame.columns) + "|"]
    cells = frame.astype(object).where(frame.notna(), "-")
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in cells.itertuples(index=False)]
    return "\n".join(lines)


def provenance(*, compiled: bool | None = None) -> str:
    """Return versions, machine and date in one line.

    Args:
        compiled: whether numba was used; None for wherever it is installed.

    """
    return made_line(made_on(), compiled=compiled)


def write(
    out: Path,
    name: str,
    *,
    csv: DataFrame,
    document: Mapping[str, Any],
    page: str,
    figures: Mapping[str, Figure],
) -> None:
    """Write NAME.csv, NAME.json, NAME.md and the figures as PNG into the folder `out`.

    Raises:
        InputError: `out` cannot be written.

    """
    whole = {**document, "report": made_on()}
    text = json.dumps(whole, indent=2, allow_nan=False) + "\n"
    with writing(out, name):
        csv.to_csv(out / f"{name}.csv", index=False)
        (out / f"{name}.json").write_text(text, encoding="utf-8")
        (out / f"{name}.md").write_text(page, encoding="utf-8")
        for stem, figure in figures.items():
            save_figure(figure, out / f"{stem}.png")
