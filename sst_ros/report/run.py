# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import matplotlib as mpl

from sst_ros.errors import InputError, Problem
from sst_ros.report import figures, formulation, jitter, page, recording, reference, summary
from sst_ros.report.thinning import thinned

SUMMARY, PAGE, HTML = "summary.json", "page.png", "page.html"


def report(bag: Path, out: Path) -> dict[str, Any]:
    """Judge a recorded run; write summary.json, the page and the pictures into `out`.

    Returns:
        The summary, as written; `table.table` makes it text.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag)
    try:
        out.mkdir(parents=True, exist_ok=True)
        told = jitter.timing(run)
        # Compiled loops let go of the interpreter: the two comparisons run beside each other.
        with ThreadPoolExecutor(1) as pool:
            beside = pool.submit(reference.ideal, run)
            integration, ideal = reference.integration(run), beside.result()
        result = summary.summarise(run, integration, ideal, formulation.check(run))
        result |= jitter.numbers(told)
        # Long jagged curves in one piece take hundreds of megabytes to draw.
        with mpl.rc_context({"agg.path.chunksize": 1000}):
            pictures = figures.draw(*thinned(run, integration, ideal), out)
            page.draw(run, integration, told, result, out / PAGE)
        result["pictures"] = [path.name for path in pictures]
        result["page"] = [PAGE, HTML]
        page.write(result, out / PAGE, pictures, out / HTML)
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / SUMMARY).write_text(text, encoding="utf-8")
    except OSError as error:
        allowed = f"must be a folder that can be written ({error})"
        raise InputError("report", [Problem("out", str(out), allowed)]) from None
    return result
