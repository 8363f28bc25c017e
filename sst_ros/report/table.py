# SPDX-License-Identifier: Apache-2.0
"""A report as text for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sst_ros.report.summary import QUANTITIES

LABEL, CELL = 36, 19


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
    yield made_line(summary)


def made_line(summary: dict[str, Any]) -> str:
    """Return versions, machine and date in one line."""
    made = summary["report"]
    return (
        f"sst_ros {made['sst_ros']}, Python {made['python']}, NumPy {made['numpy']}, "
        f"{made['platform']}, {made['processors']} processors, {made['date']}"
    )


def _row(label: str, value: Any, form: str = "", unit: str = "") -> str:
    cell = "-" if value is None else format(value, form)
    return f"  {label:{LABEL}}{cell:>{CELL}} {unit if value is not None else ''}"


def _errors(label: str, name: str, summary: dict[str, Any]) -> str:
    values = (summary[f"{name}_{quantity}_{unit}"] for quantity, unit in QUANTITIES.items())
    cells = ("-" if value is None else f"{value:.2e}" for value in values)
    return f"  {label:{LABEL}}" + "".join(f"{cell:>{CELL}}" for cell in cells)
