# SPDX-License-Identifier: Apache-2.0
"""What all reports share: tables by pandas, pages from templates by Jinja, files, provenance."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import re
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from sst_ros.errors import require
from sst_ros.host.compiled_module import numba_version
from sst_ros.host.output import write_into

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

WHOLE_RUN_S = 1.0
"""Length of a run [s] where the scene names no duration."""

_templates = jinja2.Environment(
    loader=jinja2.PackageLoader("sst_ros.report"),
    autoescape=jinja2.select_autoescape(["html"]),
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def data_frame(
    rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> DataFrame:
    """Return a DataFrame of rows; what is unknown stays None."""
    listed, names = list(rows), columns and list(columns)
    frame: DataFrame = require("pandas").DataFrame(listed, columns=names)
    for name in frame.columns:  # whole numbers with gaps stay whole numbers
        known = [row[name] for row in listed if row.get(name) is not None]
        if 0 < len(known) < len(listed) and all(type(value) is int for value in known):
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


def render(template: str, **values: Any) -> str:
    """Fill in a template of this folder; no line ends with blanks."""
    lines = _templates.get_template(template).render(values)
    return "".join(f"{line.rstrip()}\n" for line in lines.splitlines())


def publish(
    out: Path,
    name: str,
    *,
    csv: DataFrame,
    document: Mapping[str, Any],
    page: str,
    figures: Mapping[str, Figure],
) -> None:
    """Write NAME.csv, NAME.json, NAME.md and figures as PNG into `out`; InputError if it cannot."""
    from sst_ros.plot.style import save_figure  # needs matplotlib, which a summary does not

    whole = {**document, "report": made_on()}
    text = json.dumps(whole, indent=2, allow_nan=False) + "\n"
    with write_into(out, name):
        csv.to_csv(out / f"{name}.csv", index=False)
        (out / f"{name}.json").write_text(text, encoding="utf-8")
        (out / f"{name}.md").write_text(page, encoding="utf-8")
        for stem, figure in figures.items():
            save_figure(figure, out / f"{stem}.png")


def provenance(made: Mapping[str, Any] | None = None) -> str:
    """Return versions, machine and date of a report in one line: of `made_on`, by default now."""
    made = made or made_on()
    numba = f"numba {made['numba']}" if made["numba"] else "plain Python"
    return (
        f"sst_ros {made['sst_ros']}, Python {made['python']}, {numba}, NumPy {made['numpy']}, "
        f"{made['processor']}, {made['processors']} cores, {made['platform']}, {made['date']}"
    )


def made_on() -> dict[str, Any]:
    """Return versions, machine and date of a report."""
    try:
        own = metadata.version("sst_ros")
    except metadata.PackageNotFoundError:  # run from a source tree that is not installed
        own = "not installed"
    return {
        "sst_ros": own,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("numpy", "scipy", "rosbags")},
        "numba": numba_version(),
        "processor": processor(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }


def processor() -> str:
    """Return the name of the processor."""
    said = ""
    with contextlib.suppress(OSError):
        said = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    named = re.search(r"^model name\s*: *(.*\S)", said, re.MULTILINE)
    return named[1] if named else platform.machine()
