# SPDX-License-Identifier: Apache-2.0
"""How regular a recorded run was: periods, lost samples, missed ticks, pace, commands, energy.

Periods are between the receptions of consecutive samples by the recorder, so that they hold the
jitter of simulator, transport and recorder together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_ros.mechanism.geometry import Array
from sst_ros.recording.recording import Recording
from sst_ros.recording.time_series import NANOSECONDS
from sst_ros.report import energy_balance
from sst_ros.report.latency import Latency, latency

REPORTED = (
    "ticks_missed", "ticks", "step_mean_us", "error_estimate", "hold_error_start",
    "hold_error_middle",
)  # fmt: skip
"""Numbers of the diagnostics that are shown over the run."""


@dataclass(frozen=True)
class Timing:
    """Timing of a recording by its clocks, and its energy balance.

    Attributes:
        period_us: time between receptions of samples that follow each other [us], shape (p,).
        nominal_us: what it should be [us].
        lost_s: times of lost samples [s], shape (l,).
        gaps_s: times at which a tick does not begin where the one before ended [s].
        pace_s, pace: times [s] and simulated time per time on the recorder's clock.
        late_us: reception delay of each sample relative to the fastest one, by its stamp
            [us], shape (n,): it grows where the simulator falls behind.
        reported: a row for each of the simulator's reports: time of the run [s], and the numbers
            of REPORTED, nan where one was not reported, shape (r, 1 + len(REPORTED)).
        latency: of commands.
        energy: energy balance residual of each sample since the start [J], shape
            (n,); nan where it is not known. None where it cannot be known.
        missing: what is not known, and why.

    """

    period_us: Array
    nominal_us: float
    lost_s: Array
    gaps_s: Array
    pace_s: Array
    pace: Array
    late_us: Array
    reported: Array
    latency: Latency
    energy: Array | None
    missing: tuple[str, ...]


def timing(recording: Recording) -> Timing:
    """Measure a recording."""
    missing: list[str] = []
    spacing, period = np.diff(recording.time_ns), recording.period_ns
    follow = spacing == period
    received = np.diff(recording.received_ns)[follow] / 1e3
    if np.any(received < 0.0):
        missing.append("receptions are not in the order of the samples: periods are as recorded")
    lost = [
        recording.time_ns[row] + period * np.arange(1, round(spacing[row] / period))
        for row in np.flatnonzero(spacing > period).tolist()
    ]
    ticks = recording.ticks
    gaps = ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]]
    pace_s, pace = _pace(recording)
    late = recording.received_ns - recording.time_ns
    if not recording.diagnostics:
        missing.append("no diagnostics: missed ticks and samples published are not known")
    return Timing(
        received, period / 1e3,
        np.concatenate(lost) / NANOSECONDS if lost else np.empty(0),
        gaps / NANOSECONDS, pace_s, pace, (late - late.min()) / 1e3, _reported(recording),
        latency(recording, missing), energy_balance.residual(recording, missing),
        tuple(missing),
    )  # fmt: skip


def numbers(timing: Timing) -> dict[str, Any]:
    """Sum it up: flat, units in the names, None for what is not known."""
    result: dict[str, Any] = {}
    stamped = timing.latency.stamped_us
    for name, values in (
        ("period", timing.period_us),
        ("command_latency", timing.latency.received_us),
        ("command_stamp_to_tick", stamped[np.isfinite(stamped)]),
    ):
        known = len(values) > 0
        for word, function in STATISTICS.items():
            result[f"{name}_{word}_us"] = float(function(values)) if known else None
    energy = None if timing.energy is None else np.abs(timing.energy)
    known = energy is not None and bool(np.isfinite(energy).any())
    return result | {
        "commands_followed": len(timing.latency.time_s),
        "samples_answered_percent": (
            None if timing.latency.answered is None else 100.0 * timing.latency.answered
        ),
        "command_age_mean_s": timing.latency.age_s,
        "energy_residual_max_J": float(np.nanmax(energy)) if known and energy is not None else None,
        "unknown": list(timing.missing),
    }


STATISTICS: dict[str, Callable[[Array], Any]] = {
    "min": np.min,
    "mean": np.mean,
    "p99": lambda values: np.percentile(values, 99.0),
    "p99_9": lambda values: np.percentile(values, 99.9),
    "max": np.max,
}


def _pace(recording: Recording) -> tuple[Array, Array]:
    """Return times, and simulated time per received time over pieces of the run."""
    pieces = min(60, len(recording.time_ns) - 1)
    rows = np.unique(np.linspace(0, len(recording.time_ns) - 1, pieces + 1).round().astype(int))
    time, received = recording.time_ns[rows], recording.received_ns[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        pace = np.diff(time) / np.diff(received)
    good = np.isfinite(pace) & (pace > 0.0)
    return (0.5 * (time[1:] + time[:-1]) / NANOSECONDS)[good], pace[good]


def _reported(recording: Recording) -> Array:
    """Return times of the run [s] and the numbers of REPORTED, from the simulator's reports."""
    rows = [
        [at - recording.received_ns[0], *(float(values.get(key) or "nan") for key in REPORTED)]
        for at, values in recording.reports
    ]
    reported = np.array(rows, dtype=float).reshape(-1, 1 + len(REPORTED))
    since = (recording.received_ns - recording.received_ns[0]).astype(float)
    reported[:, 0] = np.interp(reported[:, 0], since, recording.seconds)
    return reported
