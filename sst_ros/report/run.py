# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from sst_ros.host.output import writing
from sst_ros.plot import pictures
from sst_ros.plot.run_figures import draw_errors
from sst_ros.plot.style import save_figure
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import formulation, page, reference, summary, text, timing
from sst_ros.report.reference import Comparison
from sst_ros.report.timing import Timing

DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that a report has, too."""

SUMMARY, PAGE, HTML = "summary.json", "page.png", "page.html"


class RunEvaluation(NamedTuple):
    """A run in numbers: timing, the two comparisons, and the summary of it all."""

    timing: Timing
    integration: Comparison
    ideal: Comparison | None
    summary: dict[str, Any]


def evaluate(run: Recording) -> RunEvaluation:
    """Evaluate a recorded run.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    measured = timing.timing(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    result = summary.summarise(run, integration, ideal, formulation.check(run))
    result |= timing.numbers(measured)
    found = text.reasons(result)
    result = {"verdict": "WARNING" if found else "OK", "reasons": found} | result
    return RunEvaluation(measured, integration, ideal, result)


def report(bag: Path, out: Path, *, damaged: bool = False) -> dict[str, Any]:
    """Evaluate a recorded run; write summary.json, the page and the pictures into `out`.

    Args:
        bag: a rosbag2 recording of a run.
        out: folder, made if it is not there.
        damaged: evaluate what is intact of a damaged recording.

    Returns:
        The summary, as written; `text.text` makes the short text of it, `text.table` the whole.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag, damaged=damaged)
    with writing(out, "report"):
        measured, integration, ideal, result = evaluate(run)
        drawn = _pictures(run, integration, ideal, out)
        save_figure(page.overview(run, integration, measured, result), out / PAGE)
        result["pictures"] = [path.name for path in drawn]
        result["page"] = [PAGE, HTML]
        page.write(result, out / PAGE, drawn, out / HTML)
        document = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / SUMMARY).write_text(document, encoding="utf-8")
    return result


def _pictures(
    run: Recording, integration: Comparison, ideal: Comparison | None, out: Path
) -> list[Path]:
    """Write the paper's figures of a run, its torques and its errors as PNG files."""
    errors = {"(a) integration error, against the same torques": page.error_curves(integration)}
    if ideal is not None:
        errors["(b) sample-and-hold error, against continuous torques"] = page.error_curves(ideal)
    title = f"Error against run time, {run.scene.name}"
    paths, _ = pictures.draw(run.signals, out, DRAWN, ["png"])
    return paths + pictures.save(draw_errors(run.seconds, errors), title, out, "error", ["png"])
