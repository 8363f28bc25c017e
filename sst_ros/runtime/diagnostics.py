# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of a run: one status a second, and at the end a table of errors over run time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from sst_ros.dynamics.model import limits_of
from sst_ros.host import processes
from sst_ros.runtime.run_loop import Phase, RunLoop
from sst_ros.runtime.tick_loop import HeldTorques, Pacer
from sst_ros.runtime.torque_input import TorqueInput
from sst_ros.scene.loads import JOINTS
from sst_ros.simulation.simulation import Simulation

OK, WARN, ERROR = range(3)
_ROWS = 32

GAUGES = {
    "error_estimate": "estimated error of the orientation [rad]",
    "rate_error_estimate": "estimated error of the body rate [rad/s]",
    "hold_error_start": "estimated error of the orientation from holding torques [rad], where "
    "they are those of the start of their hold",
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

_COUNTS = {
    "phase": "phase of the run",
    "ticks": "steps done",
    "ticks_missed": "steps dropped because the machine was late",
    "overruns": "number of such overruns",
    "clock_jumps": "times that the followed clock went back",
    "samples_published": "samples of the run published",
    "step_mean_us": "mean time of a step [us]",
    "step_max_us": "longest step [us]",
    "tick_time_left": "share of a tick's period that its step leaves, mean, at real-time factor 1",
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
    "cpu_dma_latency": "largest exit latency of idle states that the machine was asked to use",
}

KEYS = {**_COUNTS, **GAUGES, "fault": "reason why the run stopped"}
"""Keys of /diagnostics, in order."""


class RunDiagnostics:
    """Collects the counters of the parts of the node."""

    def __init__(
        self, loop: RunLoop, torque_input: TorqueInput, pacer: Pacer, period_s: float
    ) -> None:
        self._loop, self._input, self._pacer, self._period_s = loop, torque_input, pacer, period_s
        self.gauges: dict[str, object] = {}
        self.scheduling, self.cpu_dma_latency = "", processes.NO_LIMIT
        self._before = (0, 0.0)
        self._noted: dict[str, Any] = {}
        self._warned: list[str] = []
        self._rows: dict[float, tuple[list[object], float, int]] = {}  # by simulated time [s]

    def values(self, publishers: int) -> dict[str, Any]:
        """Return the value of each key that has one."""
        count, pacer, commands = self._loop.counters, self._pacer, self._input
        period, ticks, wall, age = self._period_s, count.ticks, count.wall_s, commands.age
        new, passed = ticks - self._before[0], wall - self._before[1]
        self._before = (ticks, wall)
        mean, most = count.step_mean_s, count.step_max_s
        factor = ticks * period / wall if wall else 0.0
        factor_now = new * period / passed if passed > 0 else 0.0
        dropped = ", ".join(f"{reason} {times}" for reason, times in dict(commands.reasons).items())
        row = (
            *(self._loop.phase.value, ticks, pacer.missed, pacer.overruns, pacer.jumps),
            *(count.published, 1e6 * mean, 1e6 * most, 1.0 - mean / period, 1.0 - most / period),
            *(*count.lateness_us, factor, factor_now, wall, ticks * period),
            *(commands.received, commands.dropped, dropped, commands.clamped, commands.timeouts),
            *("none" if age is None else age, publishers, count.resets, count.states_set),
            *(self.scheduling, self.cpu_dma_latency),
        )
        values: dict[str, Any] = dict(zip(_COUNTS, row, strict=True))
        values |= {**self.gauges, "fault": self._loop.fault}
        if ticks:
            keys = ("error_estimate", "energy_residual_J", "closure_residual")
            errors = [self.gauges.get(key) for key in keys]
            self._rows[ticks * period] = errors, factor, pacer.missed
        if len(self._rows) == _ROWS:  # half of those of a long run stay, and the newest
            self._rows = dict([*self._rows.items()][1::2])
        return values

    def status(self, values: dict[str, Any], warnings: list[str]) -> tuple[int, str, list[str]]:
        """Return the level, the status in a few words, and what is new to warn of.

        Values are as `values` has just read them. What the thread of the run counts meanwhile is
        reported the next time: words and values of one message never contradict each other.
        Warnings are of the graph.
        """
        running, fault = values["phase"] == Phase.RUNNING.value, values["fault"]
        said = {
            "commands_dropped": f"command dropped: {self._input.last_refusal}",
            "commands_clamped": "commands clamped to the scene's torque limit",
            "command_timeouts": "no command within command_timeout: not held",
        }
        before, self._noted = self._noted, values
        missed = values["ticks_missed"] - before.get("ticks_missed", 0)
        news = [
            f"{text} ({values[key]} in all)"
            for key, text in said.items()
            if values[key] > before.get(key, 0)
        ]
        if (publishers := values["command_publishers"]) > 1:
            news.append(f"{publishers} publishers of commands: the last message wins")
        news += [warning for warning in warnings if warning not in self._warned]
        self._warned = warnings
        doubts = [*news, *(warning for warning in warnings if warning not in news)]
        if missed:
            doubts.append(f"{missed} ticks missed")
        if self._input.stale and running:
            doubts.append("the command is too old")
        if fault:
            return ERROR, fault, news
        text = values["phase"]
        if running and values["command_age_s"] == "none":
            text += ", no command yet: zero torque"
        return (WARN, f"{text}; {'; '.join(doubts)}", news) if doubts else (OK, text, news)

    def table(self) -> Iterator[str]:
        """Yield the lines of the table of error against run time."""
        columns = "{:>12} {:>11} {:>11} {:>11} {:>10} {:>8}"
        yield columns.format("run time", "error", "energy", "closure", "real-time", "ticks")
        yield columns.format("[s]", "[rad]", "[J]", "[1]", "factor", "missed")
        for seconds, (errors, factor, missed) in self._rows.items():
            cells = (f"{value:.2e}" if isinstance(value, float) else "-" for value in errors)
            yield columns.format(f"{seconds:.3f}", *cells, f"{factor:.3f}", missed)


def read_gauges(simulation: Simulation, held: HeldTorques) -> dict[str, object]:
    """Read the gauges in the thread of the run; those without a finite value are left out."""
    state, conditioning = simulation.state, simulation.conditioning
    angles = (*state.joints.gamma, *state.joints.mu, *state.joints.beta)
    margins: dict[str, list[float]] = {"gamma": [], "mu": [], "beta": []}
    for limit in limits_of(simulation.scene, simulation.geometry):
        margins[JOINTS[limit.joint].partition("_")[0]].append(limit.distance(angles))
    row: tuple[Any, ...] = (
        *(simulation.error_estimate, simulation.rate_error_estimate),
        *(held.errors(simulation) or (None, None)),
        *(simulation.energy_residual, simulation.closure_residual),
        *(conditioning["sin_mu"], conditioning["det_j2"]),
        *(min(margins[joint], default=None) for joint in ("gamma", "beta")),
        *(simulation.method, len(simulation.changes)),
        simulation.evaluations / max(simulation.accepted_steps, 1),
        simulation.step_budget,
    )
    known = {key: x for key, x in zip(GAUGES, row, strict=True) if x is not None}
    return {key: x for key, x in known.items() if isinstance(x, str) or math.isfinite(x)}
