# SPDX-License-Identifier: Apache-2.0
"""What all reports share: tables, pages, files, provenance.

Tables are made by pandas, pages from templates by Jinja.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sst_ros.errors import require
from sst_ros.files import load_templates, write_into
from sst_ros.programs.llvm import llvmlite_version
from sst_ros.state import Array
from sst_ros.version import VERSION

if TYPE_CHECKING:
    from pandas import DataFrame

WHOLE_RUN_S = 1.0  # length of a run [s] where the scene names no duration


class Severity(Enum):
    """Weight of a finding."""

    WARNING = "warning"  # the run is not what was asked for
    NOTE = "note"  # how the numbers of the report are to be read


class Finding(NamedTuple):
    """A statement about a recorded run."""

    severity: Severity
    text: str


def verdict_of(findings: Sequence[Finding]) -> str:
    """Return WARNING if one of the findings is a warning, else OK."""
    warned = any(finding.severity is Severity.WARNING for finding in findings)
    return "WARNING" if warned else "OK"


def texts_of(findings: Sequence[Finding], severity: Severity) -> list[str]:
    """Return the texts of the findings of one severity, in their order."""
    return [finding.text for finding in findings if finding.severity is severity]


def data_frame(
    rows: Iterable[Mapping[str, Any]], names: Iterable[str] | None = None
) -> DataFrame:
    """Return a DataFrame of rows; what is unknown stays None."""
    listed = list(rows)
    columns = None if names is None else list(names)
    frame: DataFrame = require("pandas").DataFrame(listed, columns=columns)
    for name in frame.columns:  # whole numbers with gaps stay whole numbers
        present = [row[name] for row in listed if row.get(name) is not None]
        has_gaps = 0 < len(present) < len(listed)
        if has_gaps and all(type(value) is int for value in present):
            frame[name] = frame[name].astype("Int64")
    return frame


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as JSON has them: None for what is unknown."""
    return list(frame.astype(object).where(frame.notna(), None).to_dict("records"))


def largest(values: Array) -> float | None:
    """Return the largest known value; None where none is known."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def markdown(frame: DataFrame) -> str:
    """Return a table of texts as Markdown."""
    cells = frame.astype(object).where(frame.notna(), "-")
    rows = [frame.columns, ["---"] * len(frame.columns)]
    rows += cells.itertuples(index=False)
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in rows)


def render(template: str | Path, **values: Any) -> str:
    """Fill in a template, one of this folder by its name or another file.

    No line ends with blanks, and no two lines that follow each other are empty.
    """
    if isinstance(template, Path):
        jinja = _templates.from_string(template.read_text(encoding="utf-8"))
    else:
        jinja = _templates.get_template(template)
    lines = "".join(f"{line.rstrip()}\n" for line in jinja.render(values).splitlines())
    return re.sub("\n{3,}", "\n\n", lines.lstrip("\n"))


def publish(folder: Path, name: str, files: Mapping[str, Any]) -> None:
    """Write files of a report into a folder: tables, JSON documents, pages, figures.

    The name of a file that begins with a point follows that of the report. Raises
    InputError, which names the report, where `folder` cannot be written.
    """
    with write_into(folder, name):
        for file, content in files.items():
            path = folder / (f"{name}{file}" if file.startswith(".") else file)
            if hasattr(content, "to_csv"):
                content.to_csv(path, index=False)
            elif hasattr(content, "savefig"):
                from sst_ros.figures import save_figure  # needs matplotlib

                save_figure(content, path)
            else:
                if isinstance(content, Mapping):
                    document = {**content, "report": content.get("report") or made_on()}
                    content = json.dumps(document, indent=2, allow_nan=False) + "\n"
                path.write_text(content, encoding="utf-8")


def provenance(origin: Mapping[str, Any] | None = None) -> str:
    """Return versions, machine and date of a report in one line.

    They are those of `made_on`, by default of now.
    """
    origin = origin or made_on()
    compiler = "plain Python"
    if origin["llvmlite"]:
        compiler = f"llvmlite {origin['llvmlite']}"
    return (
        f"sst_ros {origin['sst_ros']}, Python {origin['python']}, {compiler}, NumPy"
        f" {origin['numpy']}, {origin['processor']}, {origin['processors']} cores,"
        f" {origin['platform']}, {origin['date']}"
    )


def made_on() -> dict[str, Any]:
    """Return versions, machine and date of a report."""
    now = datetime.datetime.now(datetime.timezone.utc)
    return {
        "sst_ros": VERSION,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("numpy", "scipy", "rosbags")},
        "llvmlite": llvmlite_version(),
        "processor": processor(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "date": now.isoformat(timespec="seconds"),
    }


def processor() -> str:
    """Return the name of the processor."""
    text = ""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    line = re.search(r"^model name\s*: *(.*\S)", text, re.MULTILINE)
    return line[1] if line else platform.machine()


_templates = load_templates("report")
_templates.globals |= {
    "base64": lambda path: b64encode(path.read_bytes()).decode("ascii"),
    "markdown": markdown,
    "provenance": provenance,
}
