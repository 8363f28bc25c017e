# SPDX-License-Identifier: Apache-2.0
"""A report as text: the verdict, its reasons and the figures that matter; and the whole table."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from typing import Any

from sst_ros.report.results import made_line

ERROR_LIMIT_RAD = 1e-9
"""Integration error above which a run is warned of, where its tolerance was not recorded."""
ANSWERED_PERCENT = 90.0
"""Share of samples that a controller at the sample rate answers."""
FORMULATION_LIMIT = 1e-9

QUANTITIES = {"gamma": "rad", "gamma_dot": "rad_per_s", "orientation": "rad"}

LABEL, CELL = 36, 19


def reasons(summary: dict[str, Any]) -> list[str]:
    """List what is wrong with a run, in order of weight; empty where nothing is."""
    return list(_reasons(summary))


def text(summary: dict[str, Any], folder: str) -> str:
    """Format verdict, figures and the place of the files."""
    found = summary["reasons"]
    lines = [f"{summary['verdict']}: {summary['scene']}" + (": " if found else "")
             + "; ".join(found)]  # fmt: skip
    lines += [f"  {label:{LABEL}}{value}" for label, value in _figures(summary)]
    files = ", ".join([*summary["page"], "summary.json", f"{len(summary['pictures'])} pictures"])
    return "\n".join([*lines, f"Files: {folder}: {files}", ""])


def _reasons(summary: dict[str, Any]) -> Iterator[str]:
    if summary["fault"]:
        yield f"fault: {summary['fault']}"
    elif summary["phase"] not in (None, "finished"):
        yield f"the run was cut short, or its recording was: last phase {summary['phase']}"
    yield from summary["damage"]
    if lost := summary["samples_lost"]:
        yield f"{lost} samples lost ({summary['samples_recorded_percent']:.2f} % recorded)"
    if gaps := summary["tick_gaps"]:
        yield f"{gaps} gaps between applied torques"
    if missed := summary["ticks_missed"]:
        yield f"{missed} ticks missed by the simulator"
    share, age = summary["samples_answered_percent"], summary["command_age_mean_s"]
    if share is not None and share < ANSWERED_PERCENT:
        yield f"commands answered {share:.3g} % of samples, mean age {1e3 * age:.3g} ms"
    error, limit = summary["integration_error_gamma_rad"], summary["error_limit_rad"]
    if error is not None and error > limit:
        yield f"integration error {error:.1e} rad above {limit:.0e} rad"
    estimate = summary["simulator_error_estimate"]
    if estimate is not None and estimate > limit:
        yield f"error estimate {estimate:.1e} rad above {limit:.0e} rad"
    difference = summary["effort_difference_max_N_m"]
    if difference and not summary["actuators_lag"]:
        yield f"efforts differ from applied torques by {difference:.1e} N m"
    if (summary["formulation_difference_relative"] or 0.0) > FORMULATION_LIMIT:
        difference = summary["formulation_difference_relative"]
        yield f"equations of motion differ from the paper's by {difference:.1e} (relative)"


def _figures(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    rate = 1.0 / summary["sample_period_s"]
    yield (
        "duration",
        f"{summary['duration_s']:.6g} s, {summary['samples_recorded']} samples at {rate:.6g} Hz",
    )
    pairs = (
        ("samples lost", "samples_lost", "d", ""),
        ("ticks missed", "ticks_missed", "d", ""),
        ("real-time factor", "real_time_factor", ".4f", ""),
        ("computing time of a step, longest", "step_max_us", ".1f", " us"),
        ("reception period, 99.9 %", "period_p99_9_us", ".1f", " us"),
        ("integration error, gamma", "integration_error_gamma_rad", ".1e", " rad"),
        ("error estimate of the simulator", "simulator_error_estimate", ".1e", " rad"),
        ("sample-and-hold error, gamma", "ideal_difference_gamma_rad", ".1e", " rad"),
        ("energy balance residual", "energy_residual_max_J", ".1e", " J"),
    )
    for label, key, form, unit in pairs:
        if summary.get(key) is not None:
            order = summary.get("hold_order") if key.startswith("ideal") else None
            theory = f", of order {order} in the period" if order else ""
            yield label, f"{summary[key]:{form}}{unit}{theory}"
    yield "peak torques", _three(summary["torque_peak_N_m"], "N m")
    if summary["tracking_error_rms_rad"] is not None:
        yield "tracking error, RMS", _three(summary["tracking_error_rms_rad"], "rad")
        yield "tracking error, maximum", _three(summary["tracking_error_max_rad"], "rad")
        settling = summary["settling_time_s"]
        yield "settling time", "not settled" if settling is None else f"{settling:.4g} s"
    if summary["command_latency_mean_us"] is not None:
        yield "delay of commands", delay(summary)


def delay(summary: dict[str, Any]) -> str:
    """Describe the delay of commands, and what a negative one means."""
    mean, least, most = (summary[f"command_latency_{word}_us"] for word in ("mean", "min", "max"))
    words = f"mean {mean:.1f} us, maximum {most:.1f} us"
    if least < 0.0:
        words += (
            f"; minimum {least:.1f} us: the recorder received a command after the step that applied"
            " it, so delays below its own are not resolved"
        )
    return words


def _three(values: list[float], unit: str) -> str:
    return ", ".join(f"{value:.3g}" for value in values) + f" {unit}"


def table(summary: dict[str, Any]) -> str:
    """Format a summary as an aligned table; what is unknown is a dash."""
    return "\n".join(line.rstrip() for line in _lines(summary)) + "\n"


def _lines(summary: dict[str, Any]) -> Iterator[str]:
    yield f"{summary['verdict']}: run of {summary['scene']}, from {summary['bag']}"
    yield from (f"  {reason}" for reason in summary["reasons"])
    yield ""
    yield _row("phase", summary["phase"])
    if summary["fault"]:
        yield f"  {'fault':{LABEL}}{summary['fault']}"
    yield _row("integrator", summary["integrator"])
    yield _row("simulated time", summary["simulated_time_s"], ".3f", "s")
    yield _row("wall time", summary["wall_time_s"], ".3f", "s")
    yield _row("real-time factor", summary["real_time_factor"], ".4f")
    yield _row("ticks done", summary["ticks"], "d")
    yield _row("ticks missed", summary["ticks_missed"], "d")
    yield _row("wall time per step, mean", summary["step_mean_us"], ".1f", "us")
    yield _row("wall time per step, longest", summary["step_max_us"], ".1f", "us")
    yield ""
    yield _row("samples published", summary["samples_published"], "d")
    share = f"({summary['samples_recorded_percent']:.2f} %)"
    yield _row("samples recorded", summary["samples_recorded"], "d", share)
    yield _row("samples lost", summary["samples_lost"], "d")
    period = f"(of {1e3 * summary['sample_period_s']:g} ms)"
    yield _row("gaps between stamps", summary["stamp_gaps"], "d", period)
    yield _row("gaps between applied torques", summary["tick_gaps"], "d")
    yield ""
    for name, key in (
        ("period of reception", "period"),
        ("command to its step", "command_latency"),
        ("stamp of command to tick", "command_stamp_to_tick"),
    ):
        for word in ("min", "mean", "p99", "p99_9", "max"):
            label = f"{name}, {word.replace('_', '.')}"
            yield _row(label, summary[f"{key}_{word}_us"], ".1f", "us")
    moment = summary["effort_difference_largest_at_s"]
    where = "N m" if moment is None else f"N m (at {moment:g} s)"
    yield _row("effort against applied torque", summary["effort_difference_max_N_m"], ".2e", where)
    yield _row("energy residual, largest", summary["energy_residual_max_J"], ".2e", "J")
    yield ""
    heads = (f"{name} [{unit.replace('_per_', '/')}]" for name, unit in QUANTITIES.items())
    yield f"{'Largest over the run':{LABEL + 2}}" + "".join(f"{head:>{CELL}}" for head in heads)
    yield _errors("(a) integration error", "integration_error", summary)
    yield _errors("    its reference's own error", "integration_reference_error", summary)
    if "ideal_difference_gamma_rad" in summary:
        order = f", order {summary['hold_order']}" if summary["hold_order"] else ""
        yield _errors(f"(b) sample-and-hold error{order}", "ideal_difference", summary)
        yield _errors("    its reference's own error", "ideal_reference_error", summary)
    states = f"(relative, {summary['formulation_states']} states)"
    yield _row(
        "kernel against the paper's equations",
        summary["formulation_difference_relative"], ".1e", states,
    )  # fmt: skip
    if summary["notes"]:
        yield ""
        yield from (f"Note: {note}." for note in summary["notes"])
    yield from (f"Not known: {words}." for words in summary["unknown"])
    yield ""
    yield from textwrap.wrap(made_line(summary["report"]), 110, break_on_hyphens=False)


def _row(label: str, value: Any, form: str = "", unit: str = "") -> str:
    cell = "-" if value is None else format(value, form)
    return f"  {label:{LABEL}}{cell:>{CELL}} {unit if value is not None else ''}"


def _errors(label: str, name: str, summary: dict[str, Any]) -> str:
    values = (summary[f"{name}_{quantity}_{unit}"] for quantity, unit in QUANTITIES.items())
    cells = ("-" if value is None else f"{value:.2e}" for value in values)
    return f"  {label:{LABEL}}" + "".join(f"{cell:>{CELL}}" for cell in cells)
