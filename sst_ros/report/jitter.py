# SPDX-License-Identifier: Apache-2.0
"""How regular a recorded run was: periods, lost samples, pace, the way of commands, energy.

Periods are between the receptions of consecutive samples by the recorder, so that they hold the
jitter of simulator, transport and recorder together.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sst_ros.integration.machine import Machine
from sst_ros.integration.system import System
from sst_ros.integration.tableaux import DOP853
from sst_ros.mechanism.compiled import Dynamics
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.report import states
from sst_ros.report.bag import Bag, Topic
from sst_ros.report.recording import Recording
from sst_ros.report.rows import NANOSECONDS

COMMANDS = Topic("commands", "/commands", "std_msgs/msg/Float64MultiArray", False)

ONE_CLOCK_NS = 10 * NANOSECONDS
"""Stamps and receptions that are farther apart than this are of different clocks."""

COMPILED_FROM = 10_000
"""From this number of ticks on it is worth compiling."""


@dataclass(frozen=True)
class Timing:
    """What the clocks of a recording say, and its balance of energy.

    Attributes:
        period_us: time between receptions of samples that follow each other [us], shape (p,).
        nominal_us: what it should be [us].
        lost_s: times of lost samples [s], shape (l,).
        gaps_s: times at which a tick does not begin where the one before ended [s].
        pace_s, pace: times [s] and simulated time per time on the recorder's clock.
        latency_s, latency_us: times of commands [s], and from the reception of a command by the
            recorder to the start of the first tick that applies it [us]; negative where the
            simulator had it earlier than the recorder.
        energy: what each sample has of energy that nobody has put in since the start [J], shape
            (n,); nan where it is not known. None where it cannot be known.
        missing: what could not be told, and why.

    """

    period_us: Array
    nominal_us: float
    lost_s: Array
    gaps_s: Array
    pace_s: Array
    pace: Array
    latency_s: Array
    latency_us: Array
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
        for row in np.flatnonzero(spacing > period)
    ]
    ticks = recording.ticks
    gaps = ticks.end_ns[:-1][ticks.start_ns[1:] != ticks.end_ns[:-1]]
    pace_s, pace = _pace(recording)
    latency_s, latency_us = _latency(recording, missing)
    energy = _energy(recording, missing)
    if not recording.diagnostics:
        missing.append("no diagnostics: missed ticks and samples published are not known")
    return Timing(
        received, period / 1e3,
        np.concatenate(lost) / NANOSECONDS if lost else np.empty(0),
        gaps / NANOSECONDS, pace_s, pace, latency_s, latency_us, energy, tuple(missing),
    )  # fmt: skip


def numbers(timing: Timing) -> dict[str, Any]:
    """Sum it up: flat, units in the names, None for what is not known."""
    result: dict[str, Any] = {}
    for name, values in (("period", timing.period_us), ("command_latency", timing.latency_us)):
        known = len(values) > 0
        for word, function in STATISTICS.items():
            result[f"{name}_{word}_us"] = float(function(values)) if known else None
    energy = None if timing.energy is None else np.abs(timing.energy)
    known = energy is not None and bool(np.isfinite(energy).any())
    return result | {
        "commands_followed": len(timing.latency_us),
        "energy_residual_max_J": float(np.nanmax(energy)) if known and energy is not None else None,
        "not_told": list(timing.missing),
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


def _latency(recording: Recording, missing: list[str]) -> tuple[Array, Array]:
    """Pair each new command with the first tick that applies it; by value, for it has no stamp."""
    none = np.empty(0), np.empty(0)
    if not recording.commands:
        missing.append("no commands are recorded: their latency is not known")
        return none
    apart = np.median(recording.received_ns - recording.time_ns) - recording.start_ns
    if abs(apart) > ONE_CLOCK_NS:
        missing.append("stamps are not of the recorder's clock: latency is not known")
        return none
    ticks = recording.ticks
    first = np.ones(len(ticks.start_ns), dtype=bool)
    first[1:] = np.any(ticks.torque[1:] != ticks.torque[:-1], axis=1)
    begins: defaultdict[tuple[float, ...], list[int]] = defaultdict(list)
    for row in np.flatnonzero(first)[::-1]:
        begins[tuple(ticks.torque[row].tolist())].append(int(ticks.start_ns[row]))
    times, latencies, before = [], [], None
    earliest = -2 * ticks.period_ns
    with Bag(recording.path, [COMMANDS]) as bag:
        for message in bag.messages():
            torque = tuple(message.content.data.tolist())
            waiting = begins.get(torque)
            at = message.received_ns - recording.start_ns
            while waiting and waiting[-1] < at + earliest:
                waiting.pop()
            if torque != before and waiting:
                times.append(at / NANOSECONDS)
                latencies.append((waiting.pop() - at) / 1e3)
            before = torque
    if not times:
        missing.append("no recorded command is found among the applied torques")
        return none
    return np.array(times), np.array(latencies)


def _energy(recording: Recording, missing: list[str]) -> Array | None:
    """Energy of the samples, less the work of the recorded torques between them."""
    moment = recording.scene.moment
    if recording.scene.stroke.at_end == "impact":
        missing.append("impacts take energy that no topic tells: no energy residual")
        return None
    if moment and moment.topic and recording.ticks.moment is None:
        missing.append("the moment on the star is not recorded: no energy residual")
        return None
    dynamics = Dynamics(recording.scene)
    ticks, geometry = recording.ticks, Geometry.of(recording.scene)
    many = len(ticks.start_ns) > COMPILED_FROM
    machine = Machine(System(dynamics, work=True), DOP853, compiled=many)
    drives = ticks.torque
    if dynamics.moved and ticks.moment is not None:
        drives = np.hstack([drives, ticks.moment])
    limit = recording.scene.actuators.torque_limit if recording.scene.actuators else None
    if limit is not None:
        drives = np.hstack([np.clip(drives[:, :3], -limit, limit), drives[:, 3:]])
    begin = np.searchsorted(ticks.start_ns, recording.time_ns)
    result = np.full(len(recording.time_ns), np.nan)
    total, rest = 0.0, (0.0,) * len(dynamics.drive)
    before: tuple[tuple[float, ...], float] | None = None
    for sample in range(len(result)):
        y = states.recorded(geometry, recording, sample)
        if y is None:
            before = None
            continue
        stored = float(sum(dynamics.energies(*y, *rest)[:2]))
        if before is not None:
            rows = range(begin[sample - 1], begin[sample])
            span = recording.time_ns[sample - 1 : sample + 1].tolist()
            work = _work(machine, ticks, drives, rows, before[0], span)
            if math.isfinite(work):  # where ticks are lost, the balance goes on without them
                total += stored - before[1] - work
        result[sample], before = total, (y, stored)
    return result


def _work(
    machine: Machine, ticks: Any, drives: Array, rows: range, y: tuple[float, ...], span: list[int]
) -> float:
    """Work over the ticks from one sample to the next [J]; nan where ticks are lost."""
    state, now = [*y, 0.0], span[0]
    for row in rows:
        start, stop = int(ticks.start_ns[row]), int(ticks.end_ns[row])
        if start != now:
            return math.nan
        try:
            state = machine.march(0.0, (stop - start) / NANOSECONDS, 1, state, drives[row].tolist())
        except (ArithmeticError, ValueError):
            return math.nan
        now = stop
    return state[-1] if now == span[1] else math.nan
