# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from sst_ros.output_folder import writing
from sst_ros.plot import paper_figures
from sst_ros.plot.downsampling import envelope
from sst_ros.plot.paper_figures import Solution
from sst_ros.plot.pictures import PICTURES, save
from sst_ros.plot.run_figures import draw_errors, draw_torques
from sst_ros.plot.style import save_figure, styled
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import formulation, page, reference, summary, timing, verdict
from sst_ros.report.reference import Comparison
from sst_ros.report.timing import Timing

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
    found = verdict.reasons(result)
    result = {"verdict": "WARNING" if found else "OK", "reasons": found} | result
    return RunEvaluation(measured, integration, ideal, result)


def report(bag: Path, out: Path, *, damaged: bool = False) -> dict[str, Any]:
    """Evaluate a recorded run; write summary.json, the page and the pictures into `out`.

    Args:
        bag: a rosbag2 recording of a run.
        out: folder, made if it is not there.
        damaged: evaluate what is intact of a damaged recording.

    Returns:
        The summary, as written; `verdict.text` makes the short text of it, `table.table` the whole.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag, damaged=damaged)
    with writing(out, "report"):
        measured, integration, ideal, result = evaluate(run)
        pictures = _pictures(run, integration, ideal, out)
        save_figure(page.overview(run, integration, measured, result), out / PAGE)
        result["pictures"] = [path.name for path in pictures]
        result["page"] = [PAGE, HTML]
        page.write(result, out / PAGE, pictures, out / HTML)
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / SUMMARY).write_text(text, encoding="utf-8")
    return result


@styled
def _pictures(
    run: Recording, integration: Comparison, ideal: Comparison | None, out: Path
) -> list[Path]:
    """Write the paper's figures of a run, its torques and its errors as PNG files."""
    scene, ticks = run.scene, run.ticks
    rows = envelope([*run.quaternion.T, *run.euler.T], len(run.time_ns))
    motion = [Solution("run", run.seconds[rows], run.quaternion[rows], run.euler[rows])]
    errors = {"(a) integration error, against the same torques": page.error_curves(integration)}
    if ideal is not None:
        errors["(b) sample-and-hold error, against continuous torques"] = page.error_curves(ideal)
    figures = {
        "path_of_E": paper_figures.path(scene, motion),
        "position_of_E": paper_figures.position_of_e(scene, motion),
        **{name: paper_figures.angle(motion, k) for k, name in enumerate(("theta", "phi", "psi"))},
        "torques": draw_torques(ticks.start_ns, ticks.end_ns, ticks.torque),
        "error": draw_errors(run.seconds, errors),
    }
    paths = []
    for name, figure in figures.items():
        title = PICTURES[name].title if name in PICTURES else "Error against run time"
        stem, title = paper_figures.caption(name, title, scene.name)
        paths += save(figure, title, out, stem, ["png"])
    return paths
