# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl

from sst_ros.output_folder import writing
from sst_ros.plot import paper_figures
from sst_ros.plot.downsampling import thinned
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import formulation, page, reference, summary, timing
from sst_ros.report.reference import Comparison
from sst_ros.report.timing import Timing

SUMMARY, PAGE, HTML = "summary.json", "page.png", "page.html"


class Judged(NamedTuple):
    """A run in numbers: when what came, the two comparisons, and the summary of it all."""

    told: Timing
    integration: Comparison
    ideal: Comparison | None
    summary: dict[str, Any]


def judge(run: Recording) -> Judged:
    """Put a recorded run in numbers.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    told = timing.timing(run)
    # Compiled loops let go of the interpreter: the two comparisons run beside each other.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    result = summary.summarise(run, integration, ideal, formulation.check(run))
    return Judged(told, integration, ideal, result | timing.numbers(told))


def report(bag: Path, out: Path) -> dict[str, Any]:
    """Judge a recorded run; write summary.json, the page and the pictures into `out`.

    Returns:
        The summary, as written; `table.table` makes it text.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag)
    with writing(out, "report"):
        told, integration, ideal, result = judge(run)
        # Long jagged curves in one piece take hundreds of megabytes to draw.
        with mpl.rc_context({"agg.path.chunksize": 1000}):
            pictures = paper_figures.draw(*thinned(run, integration, ideal), out)
            page.draw(run, integration, told, result, out / PAGE)
        result["pictures"] = [path.name for path in pictures]
        result["page"] = [PAGE, HTML]
        page.write(result, out / PAGE, pictures, out / HTML)
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / SUMMARY).write_text(text, encoding="utf-8")
    return result
