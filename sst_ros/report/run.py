# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone: numbers, page and pictures.

The numbers are one flat mapping, units in the names, nothing that is not finite; what a recording
does not contain is None, never a guess.
"""

from __future__ import annotations

import base64
import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sst_ros.host.output import write_into
from sst_ros.mechanism.geometry import Array
from sst_ros.plot import pictures
from sst_ros.plot.style import save_figure
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import overview, reference, timing, tracking
from sst_ros.report.reference import QUANTITIES, Comparison, begins
from sst_ros.report.results import made_on, provenance, render
from sst_ros.report.timing import Timing
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame

DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that a report has, too."""

SUMMARY, PAGE, HTML = "summary.json", "page.png", "page.html"

ERROR_LIMIT_RAD = 1e-9
"""Integration error above which a run is warned of, where its tolerance was not recorded."""
ANSWERED_PERCENT = 90.0
"""Share of samples that a controller at the sample rate answers."""
FORMULATION_LIMIT = 1e-9


class RunEvaluation(NamedTuple):
    """A run in numbers: timing, the two comparisons, and the summary of it all."""

    timing: Timing
    integration: Comparison
    ideal: Comparison | None
    summary: dict[str, Any]


def evaluate_run(run: Recording) -> RunEvaluation:
    """Evaluate a recorded run.

    Raises:
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    measured = timing.measure(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    result = summarise(run, integration, ideal, reference.check_with_paper(run))
    result |= measured.numbers()
    found = reasons(result)
    result = {"verdict": "WARNING" if found else "OK", "reasons": found} | result
    return RunEvaluation(measured, integration, ideal, result)


def write_run_report(bag: Path, out: Path, *, damaged: bool = False) -> dict[str, Any]:
    """Evaluate a recorded run; write summary.json, the page and the pictures into `out`.

    Args:
        bag: a rosbag2 recording of a run.
        out: folder, made if it is not there.
        damaged: evaluate what is intact of a damaged recording.

    Returns:
        The summary, as written; `summary_text` makes a short text of it, `summary_table` the whole.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag, damaged=damaged)
    with write_into(out, "report"):
        measured, integration, ideal, result = evaluate_run(run)
        errors = {"(a) integration error, against the same torques": integration}
        if ideal is not None:
            errors["(b) sample-and-hold error, against continuous torques"] = ideal
        drawn, _ = pictures.draw_run(run.signals, out, DRAWN, ["png"])
        figure = overview.draw_errors(run.seconds, errors)
        title = f"Error against run time, {run.scene.name}"
        drawn += pictures.save(figure, title, out, "error", ["png"])
        save_figure(overview.draw_overview(run, integration, measured, result), out / PAGE)
        result["pictures"] = [path.name for path in drawn]
        result["page"] = [PAGE, HTML]
        page = render(
            "run.html",
            s=result,
            table=summary_table(result),
            overview=_encode(out / PAGE),
            pictures=[(path.stem.replace("_", " "), _encode(path)) for path in drawn],
            made=provenance(result["report"]),
        )
        (out / HTML).write_text(page, encoding="utf-8")
        document = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / SUMMARY).write_text(document, encoding="utf-8")
    return result


def _encode(picture: Path) -> str:
    return base64.b64encode(picture.read_bytes()).decode("ascii")


def summary_text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures that matter and the place of the files."""
    return render("run.txt", s=summary, folder=folder)


def summary_table(summary: dict[str, Any]) -> str:
    """Format a whole summary as an aligned table; what is unknown is a dash."""
    return render("run_table.txt", s=summary, made=provenance(summary["report"]))


def reasons(summary: dict[str, Any]) -> list[str]:
    """Say what is wrong with a run, in order of weight; nothing where nothing is."""
    limits = {"answered_percent": ANSWERED_PERCENT, "formulation": FORMULATION_LIMIT}
    return render("run_reasons.txt", s=summary, **limits).splitlines()


def summarise(
    run: Recording,
    integration: Comparison,
    ideal: Comparison | None,
    formulation: tuple[float | None, int],
) -> dict[str, Any]:
    """Collect all figures of the report but those of `timing`."""
    tracked = tracking.of(run)
    found = tracked and tracked.metrics
    summary = {
        "scene": run.scene.name,
        "bag": str(run.path),
        **_read_diagnostics(run),
        **_loss(run),
        "torque_peak_N_m": np.abs(run.ticks.torque).max(axis=0).tolist(),
        "tracking_error_rms_rad": found and found.rms.tolist(),
        "tracking_error_max_rad": found and found.largest.tolist(),
        "settling_time_s": found and found.settling,
        **_largest("integration_error", integration.error, run.seconds),
        **_largest("integration_reference_error", integration.own),
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
    }
    if ideal:
        summary |= _largest("ideal_difference", ideal.error, run.seconds)
        summary |= _largest("ideal_reference_error", ideal.own)
        summary["hold_order"] = hold_order(run)
    effort = run.effort_difference
    off = float(np.nanmax(effort)) if np.isfinite(effort).any() else None
    return summary | {
        "formulation_difference_relative": formulation[0],
        "formulation_states": formulation[1],
        "effort_difference_max_N_m": off,
        "effort_difference_largest_at_s": float(run.seconds[np.nanargmax(effort)]) if off else None,
        "actuators_lag": run.scene.lags,
        "topics_missing": list(run.missing),
        "damage": list(run.signals.bag.damage),
        "notes": render(
            "run_notes.txt", run=run, integration=integration, ideal=ideal, begins=begins(run)
        ).splitlines(),
        "report": made_on(),
    }


def _read_diagnostics(run: Recording) -> dict[str, Any]:
    """Take numbers and texts from the last diagnostics of the simulator."""
    reported = run.diagnostics
    counts = ("ticks", "ticks_missed", "commands_received", "commands_dropped")
    numbers = ("simulated_time_s", "wall_time_s", "real_time_factor", "step_mean_us", "step_max_us")
    return {
        **{key: reported.get(key) for key in ("phase", "fault", "integrator")},
        **{key: _count(reported, key) for key in counts},
        **{key: _number(reported, key) for key in numbers},
        "simulator_error_estimate": _number(reported, "error_estimate"),
        "error_limit_rad": _number(reported, "tolerance") or ERROR_LIMIT_RAD,
        "duration_s": float(run.seconds[-1]),
        "commands_recorded": len(run.commands.torque),
    }


def _loss(run: Recording) -> dict[str, Any]:
    recorded, period = len(run.time_ns), run.period_ns
    spacing = np.diff(run.time_ns)
    between = int(np.sum(np.maximum(np.rint(spacing / period).astype(int) - 1, 0)))
    published = _count(run.diagnostics, "samples_published")
    # Diagnostics that end before the run does know of fewer samples than the bag holds.
    lost = max(between, 0 if published is None else published - recorded)
    return {
        "samples_published": published,
        "samples_recorded": recorded,
        "samples_lost": lost,
        "samples_recorded_percent": 100.0 * recorded / (recorded + lost),
        "sample_period_s": period / NANOSECONDS,
        "stamp_gaps": int(np.count_nonzero(spacing > period)),
        "samples_missing_between_stamps": between,
        # The last sample marks the end of the run, wherever that is.
        "stamps_off_the_period": int(np.count_nonzero(spacing[:-1] % period)),
        "orientations_lost": int(np.count_nonzero(~np.isfinite(run.quaternion[:, 0]))),
        "idle_states": run.idle_states,
        "tick_period_s": run.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(run.ticks.start_ns),
        "tick_gaps": run.ticks.gaps,
    }


def _largest(name: str, table: DataFrame, seconds: Array | None = None) -> dict[str, Any]:
    """Largest value of each column, and when that of gamma was; None where nothing is known."""
    found = {
        f"{name}_{key}_{unit}": float(table[key].max()) if table[key].count() else None
        for key, unit in QUANTITIES.items()
    }
    if seconds is not None:
        known = table.gamma.count() > 0
        found[f"{name}_gamma_largest_at_s"] = (
            float(seconds[table.gamma.argmax()]) if known else None
        )
    return found


def hold_order(run: Recording) -> int | None:
    """Order in the control period of the sample-and-hold error, by the torques that were held.

    Two where most of them are the scene's profile at the middle of a hold, one where they are that
    of another instant; None where the scene has no profile or nothing was held.
    """
    profile, ticks = run.scene.torque, run.ticks
    if profile is None or not len(ticks.start_ns):
        return None
    changes = 1 + np.flatnonzero(np.any(ticks.torque[1:] != ticks.torque[:-1], axis=1))
    first, last = np.append(0, changes), np.append(changes, len(ticks.start_ns)) - 1
    middle = (ticks.start_ns[first] + ticks.end_ns[last]) / 2 / NANOSECONDS
    off = np.abs(ticks.torque[first] - profile.values(middle)).max(axis=1)
    return 2 if np.median(off) <= 1e-9 * np.abs(profile.amplitude).max() else 1


def _number(reported: dict[str, str], key: str) -> float | None:
    try:
        value = float(reported.get(key, "nan"))
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _count(reported: dict[str, str], key: str) -> int | None:
    value = _number(reported, key)
    return None if value is None else round(value)
