# SPDX-License-Identifier: Apache-2.0
"""The run's health: one status a second, and at the end a table of error against run time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from sst_ros.runtime.gauges import GAUGES
from sst_ros.runtime.pacing import Pacer
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.run_types import Phase
from sst_ros.runtime.torque_input import CommandBoard

OK, WARN, ERROR = range(3)
_ROWS = 16

KEYS = {
    "phase": "what the run does",
    "ticks": "steps done",
    "ticks_missed": "steps dropped because the machine was late",
    "overruns": "how often some were",
    "clock_jumps": "how often the followed clock went back",
    "samples_published": "samples of the run published",
    "step_mean_us": "mean time of a step [us]",
    "step_max_us": "longest step [us]",
    "late_mean_us": "mean lateness of the steps [us]",
    "late_std_us": "standard deviation of it: the jitter of the period [us]",
    "late_max_us": "largest lateness [us]",
    "real_time_factor": "simulated time per time spent running",
    "real_time_factor_now": "the same over the last second",
    "wall_time_s": "time spent running [s]",
    "simulated_time_s": "simulated time of all steps [s]",
    "commands_received": "good commands",
    "commands_dropped": "messages that were not used",
    "commands_dropped_because": "why, with counts",
    "commands_clamped": "commands beyond the scene's torque limit",
    "command_timeouts": "how often the command became too old",
    "command_age_s": "age of the last good command [s]; none before the first",
    "command_publishers": "publishers of commands",
    "resets": "times that the run began anew",
    "states_set": "times that a state was set",
    "scheduling": "how the run's thread is scheduled",
    **GAUGES,
    "fault": "why the run stopped",
}
"""Keys of /diagnostics, in order."""


class Row(NamedTuple):
    """The run's state at one time, for the table at the end."""

    simulated_s: float
    factor: float
    missed: int
    error: object
    energy: object
    closure: object


class Health:
    """Puts together what the parts of the node count."""

    def __init__(self, loop: RunLoop, board: CommandBoard, pacer: Pacer, period_s: float) -> None:
        self._loop, self._board, self._pacer, self._period_s = loop, board, pacer, period_s
        self.gauges: dict[str, object] = {}
        self.scheduling = ""
        self._before = (0, 0.0)
        self._noted = (0, 0, 0, 0)
        self._rows: list[Row] = []
        self._last: Row | None = None
        self._count, self._stride = 0, 1

    def values(self, publishers: int) -> dict[str, object]:
        """Give the value of each key that has one."""
        count, board = self._loop.counters, self._board
        ticks, wall, factor = count.ticks, count.wall_s, 0.0
        mean, deviation, largest = count.lateness_us
        passed = wall - self._before[1]
        if passed > 0:
            factor = (ticks - self._before[0]) * self._period_s / passed
        self._before = (ticks, wall)
        age = board.age
        values = {
            "phase": self._loop.phase.value,
            "ticks": ticks,
            "ticks_missed": self._pacer.missed,
            "overruns": self._pacer.overruns,
            "clock_jumps": self._pacer.jumps,
            "samples_published": count.published,
            "step_mean_us": 1e6 * count.step_mean_s,
            "step_max_us": 1e6 * count.step_max_s,
            "late_mean_us": mean,
            "late_std_us": deviation,
            "late_max_us": largest,
            "real_time_factor": ticks * self._period_s / wall if wall else 0.0,
            "real_time_factor_now": factor,
            "wall_time_s": wall,
            "simulated_time_s": ticks * self._period_s,
            "commands_received": board.received,
            "commands_dropped": board.dropped,
            "commands_dropped_because": ", ".join(
                f"{reason} {times}" for reason, times in dict(board.reasons).items()
            ),
            "commands_clamped": board.clamped,
            "command_timeouts": board.timeouts,
            "command_age_s": "none" if age is None else age,
            "command_publishers": publishers,
            "resets": count.resets,
            "states_set": count.states_set,
            "scheduling": self.scheduling,
            **self.gauges,
            "fault": self._loop.fault,
        }
        self._keep(values)
        return values

    def judge(self, publishers: int, rivals: list[str]) -> tuple[int, str, list[str]]:
        """Tell the level, the status in a few words, and what has to be warned of since last."""
        board, loop = self._board, self._loop
        now = (board.dropped, board.clamped, board.timeouts, self._pacer.missed)
        dropped, clamped, timeouts, missed = (
            after - before for after, before in zip(now, self._noted, strict=True)
        )
        self._noted = now
        news = []
        if dropped:
            news.append(f"command dropped: {board.last_refusal} ({board.dropped} so far)")
        if clamped:
            news.append(f"commands clamped to the scene's torque limit ({board.clamped} so far)")
        if timeouts:
            news.append(f"no command within command_timeout: not held ({board.timeouts} so far)")
        if publishers > 1:
            news.append(f"{publishers} publishers of commands: the last message wins")
        if rivals:
            news.append(f"/clock is also published by {', '.join(rivals)}")
        doubts = list(news)
        if missed:
            doubts.append(f"{missed} ticks missed")
        if board.stale and loop.phase is Phase.RUNNING:
            doubts.append("the command is too old")
        if loop.fault:
            return ERROR, loop.fault, news
        said = loop.phase.value
        if loop.phase is Phase.RUNNING and not board.begun:
            said += ", no command yet: zero torque"
        return (WARN, f"{said}; {'; '.join(doubts)}", news) if doubts else (OK, said, news)

    def table(self) -> Iterator[str]:
        """Yield the lines of the table of error against run time."""
        yield (
            f"{'run time':>12} {'error':>11} {'energy':>11} {'closure':>11} "
            f"{'real-time':>10} {'ticks':>8}"
        )
        yield f"{'[s]':>12} {'[rad]':>11} {'[J]':>11} {'[1]':>11} {'factor':>10} {'missed':>8}"
        for row in [*self._rows, *filter(None, [self._last])]:
            numbers = " ".join(
                f"{value:11.2e}" if isinstance(value, float) else f"{'-':>11}"
                for value in (row.error, row.energy, row.closure)
            )
            yield f"{row.simulated_s:12.3f} {numbers} {row.factor:10.3f} {row.missed:8d}"

    def _keep(self, values: dict[str, object]) -> None:
        """Keep the newest row and some before it: never more than 16, evenly over the run."""
        row = Row(
            float(values["simulated_time_s"]),
            float(values["real_time_factor"]),
            int(values["ticks_missed"]),
            *(values.get(key) for key in ("error_estimate", "energy_residual_J")),
            values.get("closure_residual"),
        )
        if not values["ticks"]:
            return
        if self._last is not None and self._last.simulated_s != row.simulated_s:
            self._count += 1
            if self._count % self._stride == 0:
                self._rows.append(self._last)
            if len(self._rows) >= _ROWS:
                self._rows = self._rows[1::2]
                self._stride *= 2
        self._last = row
