# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone: numbers, page and pictures.

The numbers are one flat mapping, units in the names, nothing that is not finite; what a recording
does not contain is None, never a guess.
"""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sst_ros.host.output import write_into
from sst_ros.mechanism.geometry import Array
from sst_ros.plot import pictures
from sst_ros.plot.style import save_figure
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import page, reference, states, text, timing, tracking
from sst_ros.report.reference import Comparison, Deviation
from sst_ros.report.results import made_on
from sst_ros.report.states import begins, lags
from sst_ros.report.text import ERROR_LIMIT_RAD, QUANTITIES
from sst_ros.report.timing import Timing
from sst_ros.state import NANOSECONDS

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
    measured = timing.measure(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    result = summarise(run, integration, ideal, states.check_with_paper(run))
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
    with write_into(out, "report"):
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
    errors = {"(a) integration error, against the same torques": integration}
    if ideal is not None:
        errors["(b) sample-and-hold error, against continuous torques"] = ideal
    title = f"Error against run time, {run.scene.name}"
    paths, _ = pictures.draw(run.signals, out, DRAWN, ["png"])
    return paths + pictures.save(
        page.draw_errors(run.seconds, errors), title, out, "error", ["png"]
    )


def summarise(
    recording: Recording,
    integration: Comparison,
    ideal: Comparison | None,
    formulation: tuple[float | None, int],
) -> dict[str, Any]:
    """Collect all figures of the report."""
    summary: dict[str, Any] = {"scene": recording.scene.name, "bag": str(recording.path)}
    summary |= _run(recording)
    summary |= _loss(recording)
    summary |= _tracking(recording)
    summary |= _largest("integration_error", integration.error, recording.seconds)
    summary |= _largest("integration_reference_error", integration.own)
    summary |= {
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
    }
    if ideal:
        summary |= _largest("ideal_difference", ideal.error, recording.seconds)
        summary |= _largest("ideal_reference_error", ideal.own)
        summary["hold_order"] = hold_order(recording)
    summary |= {
        "formulation_difference_relative": formulation[0],
        "formulation_states": formulation[1],
        **_effort(recording),
        "actuators_lag": lags(recording.scene),
        "topics_missing": list(recording.missing),
        "damage": list(recording.signals.damage),
        "notes": list(_notes(recording, integration, ideal)),
        "report": made_on(),
    }
    return summary


def _run(recording: Recording) -> dict[str, Any]:
    reported = recording.diagnostics
    texts = ("phase", "fault", "integrator")
    counts = ("ticks", "ticks_missed", "commands_received", "commands_dropped")
    numbers = ("simulated_time_s", "wall_time_s", "real_time_factor", "step_mean_us", "step_max_us")
    return {
        **{key: reported.get(key) for key in texts},
        **{key: _count(reported, key) for key in counts},
        **{key: _number(reported, key) for key in numbers},
        "simulator_error_estimate": _number(reported, "error_estimate"),
        "error_limit_rad": _number(reported, "tolerance") or ERROR_LIMIT_RAD,
        "duration_s": float(recording.seconds[-1]),
        "commands_recorded": len(recording.commands.torque),
    }


def _tracking(recording: Recording) -> dict[str, Any]:
    """Peak torques, and the tracking error where there is a reference."""
    tracked = tracking.of(recording)
    found = None if tracked is None else tracking.metrics(tracked)
    return {
        "torque_peak_N_m": np.abs(recording.ticks.torque).max(axis=0).tolist(),
        "tracking_error_rms_rad": None if found is None else found.rms.tolist(),
        "tracking_error_max_rad": None if found is None else found.largest.tolist(),
        "settling_time_s": None if found is None else found.settling,
    }


def _loss(recording: Recording) -> dict[str, Any]:
    recorded, period = len(recording.time_ns), recording.period_ns
    spacing = np.diff(recording.time_ns)
    between = int(np.sum(np.maximum(np.rint(spacing / period).astype(int) - 1, 0)))
    published = _count(recording.diagnostics, "samples_published")
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
        "orientations_lost": int(np.count_nonzero(~np.isfinite(recording.quaternion[:, 0]))),
        "idle_states": recording.idle_states,
        "tick_period_s": recording.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(recording.ticks.start_ns),
        "tick_gaps": recording.ticks.gaps,
    }


def _largest(name: str, deviation: Deviation, seconds: Array | None = None) -> dict[str, Any]:
    """Largest value of each quantity, and when gamma's was reached."""
    result: dict[str, Any] = {}
    for quantity, unit in QUANTITIES.items():
        values = getattr(deviation, quantity)
        known = values[np.isfinite(values)]
        result[f"{name}_{quantity}_{unit}"] = float(known.max()) if len(known) else None
    if seconds is not None:
        known = np.isfinite(deviation.gamma)
        at = float(seconds[np.nanargmax(deviation.gamma)]) if known.any() else None
        result[f"{name}_gamma_largest_at_s"] = at
    return result


def hold_order(recording: Recording) -> int | None:
    """Order in the control period of the sample-and-hold error, by the torques that were held.

    Two where most of them are the scene's profile at the middle of a hold, one where they are that
    of another instant; None where the scene has no profile or nothing was held.
    """
    torque, ticks = recording.scene.torque, recording.ticks
    if torque is None or not len(ticks.start_ns):
        return None
    changes = 1 + np.flatnonzero(np.any(ticks.torque[1:] != ticks.torque[:-1], axis=1))
    first, last = np.append(0, changes), np.append(changes, len(ticks.start_ns)) - 1
    middle = (ticks.start_ns[first] + ticks.end_ns[last]) / 2 / NANOSECONDS
    amplitude, frequency, phase = map(np.array, (torque.amplitude, torque.frequency, torque.phase))
    expected = amplitude * np.sin(np.outer(middle, frequency) + phase)
    off = np.abs(ticks.torque[first] - expected).max(axis=1)
    return 2 if np.median(off) <= 1e-9 * np.abs(amplitude).max() else 1


def _effort(recording: Recording) -> dict[str, Any]:
    """Largest difference of efforts and applied torques, and when."""
    off = recording.effort_difference
    known = bool(np.isfinite(off).any())
    largest = float(np.nanmax(off)) if known else None
    at = float(recording.seconds[np.nanargmax(off)]) if largest else None
    return {"effort_difference_max_N_m": largest, "effort_difference_largest_at_s": at}


def _notes(recording: Recording, integration: Comparison, ideal: Comparison | None) -> list[str]:
    notes = []
    reported, last = recording.diagnostics, recording.seconds[-1]
    if not reported:
        notes.append("no diagnostics are recorded: missed ticks and error estimates are unknown")
    elif reported.get("phase") not in ("finished", "fault"):
        notes.append(
            f"the run or its recording was cut short: the last phase is {reported.get('phase')}"
        )
    if reported.get("phase") == "fault" or reported.get("fault"):
        notes.append(
            f"the run ended by a fault; it is compared up to its last sample, at {last:.6f} s"
        )
    if not begins(recording):
        notes.append("the start of the run is not recorded; times count from the first sample")
    lost = len(recording.time_ns) - integration.compared
    notes += integration.reasons
    if integration.restarts_ns and not integration.reasons:
        notes.append(
            f"torques are missing: the reference began again {len(integration.restarts_ns)} times "
            f"from a recorded sample; {lost} samples are not compared"
        )
    elif lost:
        notes.append(f"{lost} samples could not be compared")
    if ideal is None and recording.scene.moment and recording.scene.moment.topic:
        notes.append("the moment comes from a topic: no ideal to compare with")
    if ideal is None and recording.scene.torque is None:
        notes.append("the scene has no torques: no ideal to compare with")
    if lags(recording.scene):
        notes.append("the actuators lag: efforts differ from the torques that are asked for")
    if recording.signals.unverified:
        notes.append(
            f"{recording.signals.unverified} chunks have no checksum: damage would not be noticed"
        )
    if "euler_zyz" in recording.missing:
        notes.append("euler_zyz is not recorded: its pictures show the orientation's angles")
    return notes


def _number(reported: dict[str, str], key: str) -> float | None:
    try:
        value = float(reported[key])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _count(reported: dict[str, str], key: str) -> int | None:
    value = _number(reported, key)
    return None if value is None else round(value)
