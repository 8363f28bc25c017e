# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone: numbers, page and pictures.

The numbers are one flat mapping, units in the names, nothing that is not finite; what a recording
does not contain is None, never a guess.
"""

from __future__ import annotations

import base64
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sst_ros.host.output import write_into
from sst_ros.plot import pictures, style
from sst_ros.plot.style import BLUE, GREY, LINES, VERMILION, hide_zeros
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import reference, timing, tracking
from sst_ros.report.reference import QUANTITIES, Comparison
from sst_ros.report.results import made_on, provenance, render
from sst_ros.report.timing import Timing
from sst_ros.state import NANOSECONDS, Array

if TYPE_CHECKING:
    from pandas import DataFrame

DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
"""Pictures of `plot` that the report has, too."""

PAGE, HTML = "page.png", "page.html"

ERROR_LIMIT_RAD = 1e-9  # of the integration, where the tolerance of the run was not recorded
ANSWERED_PERCENT = 90.0  # share of samples that a controller at the sample rate answers
FORMULATION_LIMIT = 1e-9


class RunEvaluation(NamedTuple):
    """A run in numbers: timing, energy residual [J] by sample, two comparisons, and the summary."""

    timing: Timing
    energy: Array
    integration: Comparison
    ideal: Comparison | None
    summary: dict[str, Any]


def evaluate_run(run: Recording) -> RunEvaluation:
    """Evaluate a recorded run; raises as `write_run_report` does."""
    measured = timing.measure(run)
    energy, missing = reference.energy_residual(run)
    # Compiled loops release the interpreter lock: the two comparisons run in parallel.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(reference.ideal, run)
        integration, ideal = reference.integration(run), beside.result()
    numbers = {
        **_count(run, measured),
        **summarise(run, integration, ideal),
        **measured.numbers,
        "energy_residual_max_J": largest(np.abs(energy)),
        "unknown": [*measured.missing, *filter(None, [missing])],
    }
    given = {"run": run, "integration": integration, "ideal": ideal, "s": numbers}
    given |= {"answered_percent": ANSWERED_PERCENT, "formulation": FORMULATION_LIMIT}
    said = render("run_findings.txt", begins=reference.begins(run), **given).splitlines()
    notes = [line.removeprefix("Note: ") for line in said if line.startswith("Note: ")]
    wrong = [line for line in said if not line.startswith("Note: ")]  # in order of weight
    summary = {"verdict": "WARNING" if wrong else "OK", "reasons": wrong, "notes": notes} | numbers
    return RunEvaluation(measured, energy, integration, ideal, summary)


def write_run_report(bag: Path, out: Path, *, damaged: bool = False) -> dict[str, Any]:
    """Evaluate a recorded run; write summary.json, the page and the pictures into `out`.

    Of a `damaged` recording what is intact is evaluated. The summary is returned; `summary_text`
    makes a short text of it, `summary_table` the whole.

    Raises:
        InputError: the bag is no whole recording of a run, or `out` cannot be written.
        AssemblyError: the scene's initial gamma has no unique admissible assembly.

    """
    run = recording.read(bag, damaged=damaged)
    with write_into(out, "report"):
        found = evaluate_run(run)
        drawn, _ = pictures.draw_run(run.signals, out, DRAWN, ["png"])
        title = f"Error against run time, {run.scene.name}"
        drawn += pictures.save(draw_errors(run.seconds, found), title, out, "error", ["png"])
        style.save_figure(draw_overview(run, found), out / PAGE)
        result = found.summary | {"pictures": [path.name for path in drawn], "page": [PAGE, HTML]}
        encoded = {
            path.stem.replace("_", " "): base64.b64encode(path.read_bytes()).decode("ascii")
            for path in (out / PAGE, *drawn)
        }
        page = render(
            "run.html",
            s=result,
            table=summary_table(result),
            overview=encoded.pop("page"),
            pictures=encoded.items(),
            made=provenance(result["report"]),
        )
        (out / HTML).write_text(page, encoding="utf-8")
        document = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (out / "summary.json").write_text(document, encoding="utf-8")
    return result


def summary_text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures that matter and the place of the files."""
    return render("run.txt", s=summary, folder=folder)


def summary_table(summary: dict[str, Any]) -> str:
    """Format a whole summary as an aligned table; what is unknown is a dash."""
    return render("run_table.txt", s=summary, made=provenance(summary["report"]))


def summarise(run: Recording, integration: Comparison, ideal: Comparison | None) -> dict[str, Any]:
    """Collect the figures of what was computed anew: errors, tracking, the equations, efforts."""
    tracked, formulation = tracking.of(run), reference.check_with_paper(run)
    found = tracked and tracked.metrics
    ideals: dict[str, Any] = {}
    if ideal:
        ideals = {
            **_largest("ideal_difference", ideal.error),
            **_largest("ideal_reference_error", ideal.own),
            "hold_order": hold_order(run),
        }
    off = largest(run.effort_difference)
    at = float(run.seconds[np.nanargmax(run.effort_difference)]) if off else None
    return {
        "torque_peak_N_m": np.abs(run.ticks.torque).max(axis=0).tolist(),
        "tracking_error_rms_rad": found and found.rms.tolist(),
        "tracking_error_max_rad": found and found.largest.tolist(),
        "settling_time_s": found and found.settling,
        **_largest("integration_error", integration.error),
        **_largest("integration_reference_error", integration.own),
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
        **ideals,
        "formulation_difference_relative": formulation[0],
        "formulation_states": formulation[1],
        "effort_difference_max_N_m": off,
        "effort_difference_largest_at_s": at,
    }


def _count(run: Recording, measured: Timing) -> dict[str, Any]:
    """Collect what was recorded: the last diagnostics of the simulator, samples, ticks, losses."""
    period, recorded, spacing = run.period_ns, len(run.time_ns), np.diff(run.time_ns)
    said = pd.to_numeric(pd.Series(run.diagnostics, dtype=object), errors="coerce")
    numbers = {key: value for key, value in said.items() if np.isfinite(value)}
    counts = {key: round(value) for key, value in numbers.items()}
    between, published = len(measured.lost_s), counts.get("samples_published")
    # Diagnostics that end before the run does know of fewer samples than the bag holds.
    lost = max(between, (published or 0) - recorded)
    whole = ("ticks", "ticks_missed", "commands_received", "commands_dropped")
    times = ("simulated_time_s", "wall_time_s", "real_time_factor", "step_mean_us", "step_max_us")
    return {
        "scene": run.scene.name,
        "bag": str(run.path),
        **{key: run.diagnostics.get(key) for key in ("phase", "fault", "integrator")},
        **{key: counts.get(key) for key in whole},
        **{key: numbers.get(key) for key in times},
        "simulator_error_estimate": numbers.get("error_estimate"),
        "error_limit_rad": numbers.get("tolerance") or ERROR_LIMIT_RAD,
        "duration_s": float(run.seconds[-1]),
        "commands_recorded": len(run.commands.torque),
        "samples_published": published,
        "samples_recorded": recorded,
        "samples_lost": lost,
        "samples_recorded_percent": 100.0 * recorded / (recorded + lost),
        "sample_period_s": period / NANOSECONDS,
        "stamp_gaps": int(np.count_nonzero(spacing > period)),
        "samples_missing_between_stamps": between,
        "idle_states": run.idle_states,
        "tick_period_s": run.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(run.ticks.start_ns),
        "tick_gaps": run.ticks.gaps,
        "actuators_lag": run.scene.lags,
        "topics_missing": list(run.missing),
        "damage": list(run.signals.bag.damage),
        "report": made_on(),
    }


def largest(values: Array) -> float | None:
    """Return the largest known value; None where none is known."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def _largest(name: str, table: DataFrame) -> dict[str, float | None]:
    """Largest value of each column; None where nothing is known."""
    return {f"{name}_{key}_{unit}": largest(table[key]) for key, unit in QUANTITIES.items()}


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


@style.styled
def draw_errors(seconds: Array, found: RunEvaluation) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    panels = {"(a) integration error, against the same torques": found.integration}
    if found.ideal is not None:
        panels["(b) sample-and-hold error, against continuous torques"] = found.ideal
    figure, grid = style.stack(["largest difference"] * len(panels), 3.1)
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        _draw_comparison(axes, seconds, comparison)
        axes.set_title(title)
    return figure


def _draw_comparison(axes: Axes, seconds: Array, comparison: Comparison) -> None:
    """Draw the errors of a run on logarithmic axes, and the largest one of the reference."""
    least, floor = style.SMALLEST_SHOWN, np.fmax(comparison.own.max(axis=1), style.SMALLEST_SHOWN)
    axes.fill_between(
        seconds, least, floor, color=GREY, alpha=0.3, linewidth=0.0, label="error of the reference"
    )
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, looks in zip(comparison.error.to_numpy().T, names, LINES, strict=False):
        axes.plot(seconds, hide_zeros(values), label=name, **looks)
    axes.set(yscale="log", ylabel="largest difference")
    axes.set_ylim(bottom=least)
    axes.legend(fontsize=8, ncol=2, loc="lower right")


@style.styled
def draw_overview(run: Recording, found: RunEvaluation) -> Figure:
    """Draw a run on one page; a panel without data says that it has none."""
    seconds, measured, reported = run.seconds, found.timing, found.timing.reported
    figure = Figure(figsize=(12.0, 13.7))
    grid = iter(figure.subplots(4, 2).ravel())

    def panel(title: str, values: Any, xlabel: str = "time t [s]") -> Axes:
        """Begin the next panel, which shows values."""
        axes: Axes = next(grid)
        axes.set_title(title)
        axes.set_xlabel(xlabel)
        if xlabel == "time t [s]":
            axes.set_xlim(0.0, seconds[-1])
        if not np.isfinite(np.asarray(values)).any():
            axes.text(0.5, 0.5, "not recorded", transform=axes.transAxes, ha="center")
        return axes

    errors = found.integration.error
    axes = panel("Integration error, against the same torques", errors)
    _draw_comparison(axes, seconds, found.integration)
    axes = panel("Energy residual", found.energy)
    axes.set_ylabel("energy residual [J]")
    axes.plot(seconds, found.energy, color=BLUE, linewidth=1.4)
    axes = panel("Real-time factor (recorder clock)", measured.pace)
    axes.set_ylabel("real-time factor")
    axes.plot(measured.pace.index, measured.pace, color=BLUE, marker=".")
    axes.axhline(1.0, color=GREY, linewidth=0.9, linestyle="--")
    style.widen(axes, np.append(measured.pace, 1.0), 0.04)
    label = "deviation from the nominal period [µs]"
    axes = panel("Period between received samples", measured.period_us, xlabel=label)
    axes.hist(measured.period_us - run.period_ns / 1e3, bins=80, color=BLUE, log=True)
    axes.set_ylabel("samples")
    axes.set_ylim(bottom=0.5)
    missed = reported.dropna(subset="ticks_missed").set_index("time_s").ticks_missed
    total = f"{missed.iloc[-1]:g}" if len(missed) else "not recorded"
    losses = {
        f"samples lost:\n{len(measured.lost_s)}": measured.lost_s,
        f"gaps between\ntorques: {len(measured.gaps_s)}": measured.gaps_s,
        f"ticks missed:\n{total}": missed.index[missed.diff().fillna(missed) > 0.0],
    }
    axes = panel("Losses, and reports of missed ticks", seconds)
    axes.eventplot([*losses.values()], colors=VERMILION)
    axes.set_yticks(range(len(losses)), list(losses))
    axes.set_ylim(-0.6, 2.6)
    commands = measured.commands
    title = "Latency: reception of a command to the step that applies it"
    axes = panel(title, commands.received_us)
    axes.set_ylabel("latency [µs]")
    axes.plot(commands.time_s, commands.received_us, ".", color=BLUE, markersize=3)
    axes.axhline(0.0, color=GREY, linewidth=0.9, linestyle="--")
    used = (1e-6 * reported.ticks * reported.step_mean_us).to_numpy()
    # Reports come once a second: between them, and from the start, the steps cost the same.
    at = np.interp(seconds, [0.0, *reported.time_s], [0.0, *used])
    so_far = np.fmax.accumulate(errors.orientation.to_numpy())
    curves = {"integration error": (at if len(used) else np.full(len(at), np.nan), so_far)}
    for name, column in (
        ("its estimate by the simulator", "error_estimate"),
        ("hold error if torques are those of the start", "hold_error_start"),
        ("the same, of the middle", "hold_error_middle"),
    ):
        curves[name] = used, reported[column].to_numpy()
    title = "Error against computing time used, over the run"
    axes = panel(title, used, xlabel="computing time of all steps [ms]")
    axes.set(ylabel="error of the orientation [rad]", yscale="log")
    for (name, (times, values)), looks in zip(curves.items(), LINES, strict=False):
        marker = "" if name == "integration error" else "o"
        axes.plot(1e3 * times, hide_zeros(values), label=name, marker=marker, **looks)
    axes.legend(fontsize=8, loc="best")
    next(grid).set_axis_off()
    figure.suptitle(f"Run of {run.scene.name}: {seconds[-1]:g} s, {len(seconds)} samples")
    style.note(figure, provenance(found.summary["report"]), 200)
    return figure
