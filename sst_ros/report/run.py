# SPDX-License-Identifier: Apache-2.0
"""The report of one recorded run, from its bag alone: numbers, page and pictures.

The numbers are one flat mapping, units in the names, nothing that is not finite; what a recording
does not contain is None, never a guess.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sst_ros.control.tracking import tracking_table
from sst_ros.extras import require
from sst_ros.host.output import write_into
from sst_ros.mechanism.geometry import Array
from sst_ros.plot import pictures, style
from sst_ros.plot.style import BLUE, GREEN, GREY, LINES, VERMILION, Looks, hide_zeros
from sst_ros.recording import recording
from sst_ros.recording.recording import Recording
from sst_ros.report import reference, timing, tracking
from sst_ros.report.reference import QUANTITIES, Comparison
from sst_ros.report.results import made_on, provenance, render
from sst_ros.report.timing import Timing
from sst_ros.state import NANOSECONDS

if TYPE_CHECKING:
    from pandas import DataFrame

DRAWN = ("path_of_E", "position_of_E", "theta", "phi", "psi", "torques")
TRACKING_DRAWN = ("tracking", "tracking_error", "control_torques")
"""Pictures of `plot` that the reports have, too."""

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
        **summarise(run, integration, ideal),
        **measured.numbers(),
        "energy_residual_max_J": largest(np.abs(energy)),
        "unknown": [*measured.missing, *filter(None, [missing])],
    }
    # What is wrong, in order of weight.
    limits = {"answered_percent": ANSWERED_PERCENT, "formulation": FORMULATION_LIMIT}
    found = render("run_reasons.txt", s=numbers, **limits).splitlines()
    summary = {"verdict": "WARNING" if found else "OK", "reasons": found} | numbers
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
        (out / "summary.json").write_text(document, encoding="utf-8")
    return result


def _encode(picture: Path) -> str:
    return base64.b64encode(picture.read_bytes()).decode("ascii")


def write_tracking_report(bag: Path, out: Path) -> str:
    """Evaluate how a recorded run followed its reference: write table and pictures into `out`.

    The table is returned.

    Raises:
        InputError: the bag is no whole recording of a run that tracked a reference, or `out`
            cannot be written.

    """
    tracked = tracking.read_tracking(bag)
    title = f"Tracking of {tracked.recording.scene.name}, from {bag}"
    lines = [title, "", tracking_table(tracked.metrics)]
    if (worst := largest(tracked.orientation_error)) is not None:
        lines.append(f"{'orientation, largest [rad]':26}{worst:10.3e}\n")
    text = "\n".join(lines)
    with write_into(out, "report"):
        (out / "tracking.txt").write_text(text, encoding="utf-8")
    pictures.draw_run(tracked.recording.signals, out, TRACKING_DRAWN, ["png"])
    return text


def summary_text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures that matter and the place of the files."""
    return render("run.txt", s=summary, folder=folder)


def summary_table(summary: dict[str, Any]) -> str:
    """Format a whole summary as an aligned table; what is unknown is a dash."""
    return render("run_table.txt", s=summary, made=provenance(summary["report"]))


def summarise(run: Recording, integration: Comparison, ideal: Comparison | None) -> dict[str, Any]:
    """Collect all figures of the report but those of timing and energy."""
    tracked, formulation = tracking.of(run), reference.check_with_paper(run)
    found = tracked and tracked.metrics
    ideals: dict[str, Any] = {}
    if ideal:
        ideals = {
            **_largest("ideal_difference", ideal.error, run.seconds),
            **_largest("ideal_reference_error", ideal.own),
            "hold_order": hold_order(run),
        }
    effort = run.effort_difference
    off = largest(effort)
    given = {"run": run, "integration": integration, "ideal": ideal}
    return {
        "scene": run.scene.name,
        "bag": str(run.path),
        **_count(run),
        "torque_peak_N_m": np.abs(run.ticks.torque).max(axis=0).tolist(),
        "tracking_error_rms_rad": found and found.rms.tolist(),
        "tracking_error_max_rad": found and found.largest.tolist(),
        "settling_time_s": found and found.settling,
        **_largest("integration_error", integration.error, run.seconds),
        **_largest("integration_reference_error", integration.own),
        "reference_steps_per_tick": integration.steps,
        "samples_compared": integration.compared,
        "restarts_at_s": [time / NANOSECONDS for time in integration.restarts_ns],
        **ideals,
        "formulation_difference_relative": formulation[0],
        "formulation_states": formulation[1],
        "effort_difference_max_N_m": off,
        "effort_difference_largest_at_s": float(run.seconds[np.nanargmax(effort)]) if off else None,
        "actuators_lag": run.scene.lags,
        "topics_missing": list(run.missing),
        "damage": list(run.signals.bag.damage),
        "notes": render("run_notes.txt", begins=reference.begins(run), **given).splitlines(),
        "report": made_on(),
    }


def _count(run: Recording) -> dict[str, Any]:
    """Numbers and texts of the last diagnostics of the simulator; samples and ticks, and losses."""
    pandas, period, recorded = require("pandas"), run.period_ns, len(run.time_ns)
    said = pandas.Series(run.diagnostics, dtype=object)
    numbers = {k: x for k, x in pandas.to_numeric(said, errors="coerce").items() if np.isfinite(x)}
    counts = {key: round(value) for key, value in numbers.items()}
    spacing = np.diff(run.time_ns)
    between = int(np.sum(np.maximum(np.rint(spacing / period).astype(int) - 1, 0)))
    published = counts.get("samples_published")
    # Diagnostics that end before the run does know of fewer samples than the bag holds.
    lost = max(between, (published or 0) - recorded)
    whole = ("ticks", "ticks_missed", "commands_received", "commands_dropped")
    times = ("simulated_time_s", "wall_time_s", "real_time_factor", "step_mean_us", "step_max_us")
    return {
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
        # The last sample marks the end of the run, wherever that is.
        "stamps_off_the_period": int(np.count_nonzero(spacing[:-1] % period)),
        "orientations_lost": int(np.count_nonzero(~np.isfinite(run.quaternion[:, 0]))),
        "idle_states": run.idle_states,
        "tick_period_s": run.ticks.period_ns / NANOSECONDS,
        "ticks_recorded": len(run.ticks.start_ns),
        "tick_gaps": run.ticks.gaps,
    }


def largest(values: Array) -> float | None:
    """Return the largest known value; None where none is known."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else None


def _largest(name: str, table: DataFrame, seconds: Array | None = None) -> dict[str, Any]:
    """Largest value of each column, and when that of gamma was; None where nothing is known."""
    found = {f"{name}_{key}_{unit}": largest(table[key]) for key, unit in QUANTITIES.items()}
    if seconds is not None:
        known = table.gamma.count() > 0
        at = float(seconds[table.gamma.argmax()]) if known else None
        found[f"{name}_gamma_largest_at_s"] = at
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


@style.styled
def draw_errors(seconds: Array, found: RunEvaluation) -> Figure:
    """Draw errors over run time, a panel for each comparison, on logarithmic axes."""
    panels = {"(a) integration error, against the same torques": found.integration}
    if found.ideal is not None:
        panels["(b) sample-and-hold error, against continuous torques"] = found.ideal
    figure, grid = style.stack(["largest difference"] * len(panels), 3.1)
    for axes, (title, comparison) in zip(grid, panels.items(), strict=True):
        _draw_comparison(axes, seconds, comparison, legend=axes is grid[0])
        axes.set_title(title)
    return figure


def _draw_comparison(
    axes: Axes, seconds: Array, comparison: Comparison, *, legend: bool = True
) -> None:
    """Draw the errors of a run on logarithmic axes, and the largest one of the reference."""
    least, floor = style.SMALLEST_SHOWN, comparison.own.max(axis=1)
    band: Looks = {"color": GREY, "alpha": 0.3, "linewidth": 0.0, "label": "error of the reference"}
    axes.fill_between(seconds, least, np.fmax(floor, least), **band)
    names = ("γ [rad]", "γ̇ [rad/s]", "orientation [rad]")
    for values, name, looks in zip(comparison.error.to_numpy().T, names, LINES, strict=False):
        axes.plot(seconds, hide_zeros(values), label=name, **looks)
    axes.set(yscale="log", ylabel="largest difference")
    axes.set_ylim(bottom=least)
    if legend and comparison.compared:
        axes.legend(fontsize=8, ncol=2, loc="lower right")


class Panel(NamedTuple):
    """A panel of the overview; `missing` is the reason why it is left out, or empty."""

    title: str
    draw: Callable[[Axes], None]
    missing: str = ""
    over_time: bool = True


@style.styled
def draw_overview(run: Recording, found: RunEvaluation) -> Figure:
    """Draw a run on one page; the footnote names what has no data."""
    panels = [*_panels(run, found)]
    shown = [panel for panel in panels if not panel.missing]
    rows = -(-len(shown) // 2)
    figure = Figure(figsize=(12.0, 3.3 * rows + 0.5))
    grid = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, panel in zip(grid, shown, strict=False):
        axes.set_title(panel.title)
        panel.draw(axes)
        if panel.over_time:
            axes.set_xlabel("time t [s]")
            axes.set_xlim(0.0, run.seconds[-1])
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    title = f"Run of {run.scene.name}: {run.seconds[-1]:g} s, {len(run.time_ns)} samples"
    figure.suptitle(title, fontsize=13)
    absent = " ".join(f"{panel.title}: {panel.missing}." for panel in panels if panel.missing)
    footnote = f"{absent}\n{provenance(found.summary['report'])}".strip()
    figure.supxlabel(footnote, fontsize=8, color="#555555")
    return figure


def _panels(run: Recording, found: RunEvaluation) -> Iterator[Panel]:
    seconds, measured, commands = run.seconds, found.timing, found.timing.commands
    reported, error = measured.reported, found.integration
    compared = "" if error.compared else "nothing could be compared"
    title = "Integration error, against the same torques"
    yield Panel(title, lambda axes: _draw_comparison(axes, seconds, error), compared)
    yield _curve("Energy residual", "energy residual [J]", seconds, found.energy)
    looks: Looks = {"around": 1.0, "marker": ".", "linewidth": 1.2}
    times, pace = measured.pace.index.to_numpy(), measured.pace.to_numpy()
    yield _curve("Real-time factor (recorder clock)", "real-time factor", times, pace, **looks)
    title, missing = "Period between received samples", _missing(measured.period_us)
    draw = partial(_draw_periods, measured=measured, summary=found.summary)
    yield Panel(title, draw, missing, over_time=False)
    yield Panel("Cumulative losses", lambda axes: _draw_losses(axes, measured, seconds[-1]))
    title = "Latency: reception of a command to the step that applies it"
    dots: Looks = {"around": 0.0, "linestyle": "none", "marker": ".", "markersize": 3}
    yield _curve(title, "latency [µs]", commands.time_s, commands.received_us, **dots)
    late = measured.late_us / 1e3
    yield _curve("Delay of samples", "delay, less the shortest [ms]", seconds, late)
    title, effort = "Effort of joint_states against applied torque", run.effort_difference
    panel = _curve(title, "largest difference [N m]", seconds, effort)
    yield panel._replace(missing="no difference") if largest(effort) == 0.0 else panel
    used = (1e-6 * reported.ticks * reported.step_mean_us).to_numpy()
    # Reports come once a second: between them, and from the start, the steps cost the same.
    at_samples = np.interp(seconds, [0.0, *reported.time_s], [0.0, *used])
    so_far = np.fmax.accumulate(error.error.orientation.to_numpy())
    estimates = {
        "integration error": (at_samples if len(used) else np.full(len(seconds), np.nan), so_far),
        "its estimate by the simulator": (used, reported.error_estimate.to_numpy()),
        "hold error if torques are those of the start": (
            used,
            reported.hold_error_start.to_numpy(),
        ),
        "the same, of the middle": (used, reported.hold_error_middle.to_numpy()),
    }
    drawn = any((np.isfinite(hide_zeros(y)) & np.isfinite(x)).any() for x, y in estimates.values())
    title, missing = (
        "Error against computing time used, over the run",
        "" if drawn else NOT_RECORDED,
    )
    yield Panel(title, partial(_draw_used, estimates=estimates), missing, over_time=False)
    title = "Computing time of a step, mean since the start"
    timed = reported[reported.step_mean_us > 0.0]
    yield _curve(title, "time [µs]", timed.time_s, timed.step_mean_us, marker="o")


NOT_RECORDED = "not recorded"


def _missing(values: Array) -> str:
    """Return why a panel of values is left out; empty where some of them are known."""
    return "" if np.isfinite(values).any() else NOT_RECORDED


def _curve(
    title: str, label: str, x: Any, y: Any, around: float | None = None, **looks: Any
) -> Panel:
    """Return a panel of one curve; small values in a power of ten, or around a line."""
    seconds, values = np.asarray(x), np.asarray(y)

    def draw(axes: Axes) -> None:
        shown, unit = (values, "") if around is not None else style.scale_down(values)
        axes.set_ylabel(label.replace("[", f"[{unit}"))
        axes.plot(seconds, shown, color=BLUE, **{"linewidth": 1.4, "markersize": 4} | looks)
        if around is not None:
            axes.axhline(around, color=GREY, linewidth=0.9, linestyle="--")
            style.widen(axes, np.append(shown, around), 0.04)

    return Panel(title, draw, _missing(values))


def _draw_used(axes: Axes, estimates: Mapping[str, tuple[Array, Array]]) -> None:
    """Draw errors [rad] over computing time [s] by name; what was reported is marked."""
    axes.set(xlabel="computing time of all steps [ms]", ylabel="error of the orientation [rad]")
    for (name, (used, values)), looks in zip(estimates.items(), LINES, strict=False):
        marker = "" if name == "integration error" else "o"
        axes.plot(1e3 * used, hide_zeros(values), label=name, marker=marker, markersize=4, **looks)
    axes.set_yscale("log")
    axes.legend(fontsize=8, loc="best")


def _draw_periods(axes: Axes, measured: Timing, summary: dict[str, Any]) -> None:
    """Draw the histogram of periods between received samples around the nominal one [us]."""
    axes.set(xlabel="deviation from the nominal period [µs]", ylabel="samples")
    off = measured.period_us - measured.nominal_us
    reach = max(1.0, 1.05 * float(np.abs(off).max()))
    axes.hist(off, bins=np.linspace(-reach, reach, 81).tolist(), color=BLUE, log=True)
    axes.set_ylim(bottom=0.5)
    words = {"min": "min", "mean": "mean", "max": "max", "p99": "p99", "p99_9": "p99.9"}
    numbers = {name: summary[f"period_{word}_us"] for word, name in words.items()}
    for name, colour, line in (("p99", VERMILION, "--"), ("p99.9", GREEN, ":")):
        place = numbers[name] - measured.nominal_us
        axes.axvline(place, color=colour, linestyle=line, linewidth=1.5, label=name)
    lines = [("nominal", measured.nominal_us), *numbers.items()]
    text = "\n".join(f"{name} {value:.1f} µs" for name, value in lines)
    axes.text(0.02, 0.96, text, transform=axes.transAxes, va="top", fontsize=8.5)
    axes.legend(fontsize=8, loc="upper right")


def _draw_losses(axes: Axes, measured: Timing, end: float) -> None:
    """Draw running counts of losses over time [s]."""
    axes.set_ylabel("count")
    missed = measured.reported.dropna(subset="ticks_missed")
    events = {"samples lost": measured.lost_s, "gaps between applied torques": measured.gaps_s}
    losses = {name: (np.sort(at), np.arange(1.0, len(at) + 1.0)) for name, at in events.items()}
    if len(missed):
        losses["ticks missed"] = missed.time_s.to_numpy(), missed.ticks_missed.to_numpy()
    else:
        axes.plot([], [], " ", label="ticks missed: not recorded")
    most = 0.0
    for (name, loss), looks in zip(losses.items(), LINES, strict=False):
        times, counts = (np.append(0.0, numbers) for numbers in loss)
        times, counts = np.append(times, end), np.append(counts, counts[-1])
        label = f"{name}: {counts[-1]:.0f}"
        axes.step(times, counts, where="post", label=label, **looks)
        most = max(most, counts[-1])
    axes.set_ylim(0.0, max(1.0, 1.6 * most))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.legend(fontsize=8, loc="upper left")
