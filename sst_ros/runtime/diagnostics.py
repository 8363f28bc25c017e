# SPDX-License-Identifier: Apache-2.0
"""What a run says of itself: a status once a second, and at its end a table of errors.

Gauges are read in the thread of the run, between two samples; all else may be read at
any time. A value that a run does not have is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from sst_ros.dynamics.model import limits_of
from sst_ros.runtime import scheduling
from sst_ros.runtime.run_loop import Phase, RunLoop
from sst_ros.runtime.tick_loop import HeldTorques
from sst_ros.scene.loads import JOINTS
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS

OK, WARN, ERROR = range(3)
"""Levels of a status."""
_MOST_ROWS = 32
"""Of the table: it fits a screen."""

GAUGES = {
    "error_estimate": "estimated error of the orientation [rad]",
    "rate_error_estimate": "estimated error of the body rate [rad/s]",
    "hold_error_start": "estimated error of the orientation from holding torques [rad],"
    " where they are those of the start of their hold",
    "hold_error_middle": "the same where they are those of its middle",
    "energy_residual_J": "energy less that of the start and the work done since [J]",
    "closure_residual": "largest abs(r_k . t_k), 0 where the loops are closed",
    "singularity_serial": "least sin(mu_k), 0 at a serial singularity",
    "singularity_parallel": "det J2, 0 at a parallel singularity",
    "stroke_margin_rad": "least distance of gamma to an end of the stroke [rad]",
    "workspace_margin_rad": "least distance of beta to the edge of the workspace [rad]",
    "integrator": "method in use",
    "integrator_changes": "number of changes of the method",
    "step_evaluations": "mean evaluations of the right-hand side per accepted step",
    "step_budget": "evaluations that one tick may take",
}
"""Keys of the values that the simulation itself reports."""

COUNTS = {
    "phase": "phase of the run",
    "ticks": "steps done",
    "ticks_missed": "steps dropped because the machine was late",
    "overruns": "number of such overruns",
    "clock_jumps": "times that the followed clock went back",
    "samples_published": "samples of the run published",
    "step_mean_us": "mean time of a step [us]",
    "step_max_us": "longest step [us]",
    "tick_time_left": "share of a tick's period that its step leaves, mean, at"
    " real-time factor 1",
    "tick_time_left_least": "the same of the longest step",
    "late_mean_us": "mean lateness of the steps [us]",
    "late_std_us": "standard deviation of it: the jitter of the period [us]",
    "late_max_us": "largest lateness [us]",
    "real_time_factor": "simulated time per time spent running",
    "real_time_factor_now": "the same over the last second",
    "wall_time_s": "time spent running [s]",
    "simulated_time_s": "simulated time of all steps [s]",
    "commands_received": "valid commands",
    "commands_dropped": "messages that were not used",
    "commands_dropped_because": "reasons, with counts",
    "commands_clamped": "commands beyond the scene's torque limit",
    "command_timeouts": "times that the command became too old",
    "command_age_s": "age of the last valid command [s]; none before the first",
    "command_publishers": "publishers of commands",
    "resets": "times that the run began anew",
    "states_set": "times that a state was set",
    "scheduling": "scheduling of the thread of the run",
    "cpu_dma_latency": "largest exit latency of idle states that the machine was asked"
    " to use",
}
"""Keys of the values that the run counts."""

KEYS = {**COUNTS, **GAUGES, "fault": "reason why the run stopped"}
"""Keys of /diagnostics, in order."""


class _TableRow(NamedTuple):
    """The errors of a run up to an instant; None where there is no estimate."""

    orientation: object  # [rad]
    energy: object  # [J]
    closure: object
    real_time_factor: float
    missed: int


class Status(NamedTuple):
    """What is said of a run now."""

    level: int  # OK, WARN or ERROR
    text: str
    news: list[str]  # warnings that were not given before


class RunDiagnostics:
    """Collects the counters of the parts of a run.

    Attributes:
        gauges: the last values of `read_gauges`.
        granted: what the system permits, by key.

    """

    def __init__(self, loop: RunLoop) -> None:
        self._loop = loop
        self.gauges: dict[str, object] = {}
        self.granted = {"scheduling": "", "cpu_dma_latency": scheduling.NO_LIMIT}
        self._last: dict[str, Any] = {}  # values of the status before
        self._last_warnings: list[str] = []
        self._rows: dict[float, _TableRow] = {}  # by simulated time [s]

    def values(self, publishers: int) -> dict[str, Any]:
        """Return the value of each key that has one.

        Publishers are those of commands.
        """
        counters = self._loop.counters
        run, commands, pacer, _ = self._loop.parts
        period = run.period_ns / NANOSECONDS
        ticks = counters.ticks
        wall = counters.wall_s
        step_mean = counters.step_mean_s
        step_max = counters.step_max_s
        late_mean, late_deviation, late_max = counters.lateness_us
        new_ticks = ticks - self._last.get("ticks", 0)
        new_wall = wall - self._last.get("wall_time_s", 0.0)
        age = commands.age
        reasons = dict(commands.reasons)  # the thread of the run may add some meanwhile
        values: dict[str, Any] = {
            "phase": self._loop.phase.value,
            "ticks": ticks,
            "ticks_missed": pacer.missed,
            "overruns": pacer.overruns,
            "clock_jumps": pacer.jumps,
            "samples_published": counters.published,
            "step_mean_us": 1e6 * step_mean,
            "step_max_us": 1e6 * step_max,
            "tick_time_left": 1.0 - step_mean / period,
            "tick_time_left_least": 1.0 - step_max / period,
            "late_mean_us": late_mean,
            "late_std_us": late_deviation,
            "late_max_us": late_max,
            "real_time_factor": ticks * period / wall if wall else 0.0,
            "real_time_factor_now": new_ticks * period / new_wall if new_wall else 0.0,
            "wall_time_s": wall,
            "simulated_time_s": ticks * period,
            "commands_received": commands.received,
            "commands_dropped": commands.dropped,
            "commands_dropped_because": ", ".join(
                f"{reason} {count}" for reason, count in reasons.items()
            ),
            "commands_clamped": commands.clamped,
            "command_timeouts": commands.timeouts,
            "command_age_s": "none" if age is None else age,
            "command_publishers": publishers,
            "resets": counters.resets,
            "states_set": counters.states_set,
            **self.granted,
            **self.gauges,
            "fault": self._loop.fault,
        }
        if ticks:
            self._note_row(values)
        return values

    def _note_row(self, values: dict[str, Any]) -> None:
        """Add a row to the table.

        Of a long run half of the rows stay, and the newest.
        """
        self._rows[values["simulated_time_s"]] = _TableRow(
            orientation=values.get("error_estimate"),
            energy=values.get("energy_residual_J"),
            closure=values.get("closure_residual"),
            real_time_factor=values["real_time_factor"],
            missed=values["ticks_missed"],
        )
        if len(self._rows) == _MOST_ROWS:
            rows = list(self._rows.items())
            self._rows = dict(rows[1::2])

    def status(self, values: dict[str, Any], warnings: list[str]) -> Status:
        """Return what is said of a run whose values have just been read.

        What the thread of the run counts meanwhile is reported the next time: words and
        values of one message never contradict each other. Warnings are of the graph.
        """
        commands = self._loop.parts.torque_input
        news = self._news_of(values, commands.last_refusal)
        news += [warning for warning in warnings if warning not in self._last_warnings]
        doubts = [*news, *(warning for warning in warnings if warning not in news)]
        missed = values["ticks_missed"] - self._last.get("ticks_missed", 0)
        self._last = values
        self._last_warnings = warnings
        if values["fault"]:
            return Status(ERROR, values["fault"], news)
        is_running = values["phase"] == Phase.RUNNING.value
        if missed:
            doubts.append(f"{missed} ticks missed")
        if commands.stale and is_running:
            doubts.append("the command is too old")
        text = values["phase"]
        if is_running and values["command_age_s"] == "none":
            text += ", no command yet: zero torque"
        if doubts:
            return Status(WARN, f"{text}; {'; '.join(doubts)}", news)
        return Status(OK, text, news)

    def _news_of(self, values: dict[str, Any], last_refusal: str) -> list[str]:
        """Say which counts of faults have grown since the last status."""
        texts = {
            "commands_dropped": f"command dropped: {last_refusal}",
            "commands_clamped": "commands clamped to the scene's torque limit",
            "command_timeouts": "no command within command_timeout: not held",
        }
        news = [
            f"{text} ({values[key]} in all)"
            for key, text in texts.items()
            if values[key] > self._last.get(key, 0)
        ]
        publishers = values["command_publishers"]
        if publishers > 1:
            news.append(f"{publishers} publishers of commands: the last message wins")
        return news

    def table(self) -> Iterator[str]:
        """Yield the lines of the table of error against run time."""
        columns = "{:>12} {:>11} {:>11} {:>11} {:>10} {:>8}"
        yield columns.format(
            "run time", "error", "energy", "closure", "real-time", "ticks"
        )
        yield columns.format("[s]", "[rad]", "[J]", "[1]", "factor", "missed")
        for seconds, row in self._rows.items():
            errors = (row.orientation, row.energy, row.closure)
            yield columns.format(
                f"{seconds:.3f}",
                *(f"{x:.2e}" if isinstance(x, float) else "-" for x in errors),
                f"{row.real_time_factor:.3f}",
                row.missed,
            )


def read_gauges(simulation: Simulation, held_torques: HeldTorques) -> dict[str, object]:
    """Read the gauges in the thread of the run.

    Those without a finite value are left out.
    """
    conditioning = simulation.conditioning
    hold_errors = held_torques.errors(simulation)
    of_start, of_middle = (None, None) if hold_errors is None else hold_errors
    margins = _margins_of(simulation)
    gauges = {
        "error_estimate": simulation.error_estimate,
        "rate_error_estimate": simulation.rate_error_estimate,
        "hold_error_start": of_start,
        "hold_error_middle": of_middle,
        "energy_residual_J": simulation.energy_residual,
        "closure_residual": simulation.closure_residual,
        "singularity_serial": conditioning["sin_mu"],
        "singularity_parallel": conditioning["det_j2"],
        "stroke_margin_rad": margins.get("gamma"),
        "workspace_margin_rad": margins.get("beta"),
        "integrator": simulation.method,
        "integrator_changes": len(simulation.changes),
        "step_evaluations": simulation.evaluations / max(simulation.accepted_steps, 1),
        "step_budget": simulation.step_budget,
    }
    return {key: value for key, value in gauges.items() if _is_told(value)}


def _margins_of(simulation: Simulation) -> dict[str, float]:
    """Return the least distance from a limit [rad] by kind of joint with limits."""
    joints = simulation.state.joints
    angles = (*joints.gamma, *joints.mu, *joints.beta)
    margins: dict[str, float] = {}
    for limit in limits_of(simulation.scene, simulation.geometry):
        joint_letter = JOINTS[limit.joint].partition("_")[0]
        distance = limit.distance(angles)
        margins[joint_letter] = min(distance, margins.get(joint_letter, math.inf))
    return margins


def _is_told(value: object) -> bool:
    if isinstance(value, (int, float)):
        return math.isfinite(value)
    return value is not None
