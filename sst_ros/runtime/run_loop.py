# SPDX-License-Identifier: Apache-2.0
"""State machine of a run: waiting, running, paused, fault, finished.

One thread owns it.

Other threads send requests by `ask`. They are served between two samples, in the thread
of the run. Diagnostics: one status a second, and at the end a table of errors over run
time.
"""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from enum import Enum
from typing import Any, NamedTuple

from sst_ros.dynamics.model import limits_of
from sst_ros.errors import RunStopped, SstError
from sst_ros.runtime import scheduling
from sst_ros.runtime.tick_loop import (
    IDLE_PERIOD_S,
    HeldTorques,
    NoAnswer,
    RunParts,
    TickLoop,
)
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene, with_initial
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import NANOSECONDS, Vector3

_POLL_S = 0.001
_REPLY_S = 30.0


class Phase(str, Enum):
    """Phase of a run."""

    WAITING = "waiting"
    RUNNING = "running"
    PAUSED = "paused"
    FAULT = "fault"
    FINISHED = "finished"


class Reply(NamedTuple):
    """Answer to a request."""

    success: bool
    message: str


_NOT_DONE = Reply(False, "not done: the run has ended or failed")


class RunLoop(TickLoop):
    """State machine of one node's run, whose ticks are those of a `TickLoop`."""

    def __init__(
        self, scene: Scene, build: Callable[[Scene], Simulation], parts: RunParts
    ) -> None:
        self.phase, self.fault = Phase.WAITING, ""  # why the run stopped, until a reset
        self.failed = False  # the fault ends the node: nothing is left to wait for
        self._build, self._original = build, build(scene)
        super().__init__(self._original, parts)
        self._requests: deque[tuple[Callable[[], Reply | None], Future[Reply]]] = (
            deque()
        )
        self._missing_since: float | None = time.monotonic()

    def ask(self, request: Callable[[], Reply]) -> Reply:
        """Have a request (`pause`, `reset`, ...) served by the thread of the run.

        Wait for it.

        The wait ends early where the run has stopped.
        """
        pending = self.post(request)
        deadline = time.monotonic() + _REPLY_S
        while not wait([pending], _POLL_S).done:
            ends = self.stopped.is_set() or time.monotonic() > deadline
            if ends and not pending.done():  # it may have been served just before
                pending.cancel()
                return Reply(False, f"not done: {self.fault or 'the node is ending'}")
        return pending.result()

    def post(self, request: Callable[[], Reply | None]) -> Future[Reply]:
        """Have a request served, which has succeeded where it gives no reply.

        Do not wait.
        """
        pending: Future[Reply] = Future()
        self._requests.append((request, pending))
        self.requested.set()
        return pending

    def stop(self) -> None:
        """Make `run` return soon."""
        self.stopped.set()
        self.requested.set()

    def run(self) -> None:
        """Run until `stop`, the end of the run, or a fault of a run with a duration."""
        self._missing_since = time.monotonic()
        self._output.publish_phase(self._status)
        warm, shown = False, -math.inf
        while not (
            self.stopped.is_set() or self.phase is Phase.FINISHED or self.failed
        ):
            try:
                if not warm:
                    warm = True
                    self.warm_up()
                if self.requested.is_set():
                    self._serve()
                if self.phase is Phase.WAITING and not self._start(self._run.waits):
                    if time.monotonic() - shown > IDLE_PERIOD_S:
                        shown = time.monotonic()
                        self.show(fault=False, waits=True)
                    time.sleep(_POLL_S)
                elif self.phase is Phase.RUNNING:
                    if self.to_next_sample(paced=True) and self.complete:
                        self._rest(Phase.FINISHED)
                elif self.phase in (Phase.PAUSED, Phase.FAULT):
                    self.show(fault=bool(self.fault))
                    self.requested.wait(IDLE_PERIOD_S)
            except (RunStopped, NoAnswer) as stopped:
                self._fail(str(stopped))
            except Exception as error:
                at = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{at.filename.rpartition('/')[2]}:{at.lineno}"
                self._fail(f"internal error: {type(error).__name__}: {error} ({where})")
                self.stopped.wait(IDLE_PERIOD_S)
        self.publish_rest()
        self.counters.hold()
        self.stopped.set()
        self._serve(refuses=True)

    def pause(self, paused: bool) -> Reply:
        """Pause the run, or resume it; idempotent."""
        if self.phase is Phase.FAULT:
            return Reply(False, f"fault, reset first: {self.fault}")
        if paused:
            reply = "already paused" if self.phase is Phase.PAUSED else "paused"
            self._rest(Phase.PAUSED)
            return Reply(True, reply)
        if self.phase is not Phase.PAUSED:
            return Reply(True, f"not paused: {self.phase.value}")
        if self.begun:
            self._resume()
        else:
            self._to(Phase.WAITING)
            # With /clock in lockstep an update for each wait would come before the run.
            self._start(self._run.waits and not self._idle_step_ns)
        return Reply(True, self.phase.value)

    def step(self, samples: int = 1) -> Reply:
        """Advance a paused run by some samples, with the torques of the last command."""
        if self.phase is not Phase.PAUSED:
            return Reply(
                False,
                f"refused: only a paused run can be stepped, it is {self._status}",
            )
        if not self.begun and not self.begin():
            return Reply(False, "refused: there is no time yet on /clock")
        for _ in range(samples):
            self.refresh()
            try:
                if not self.to_next_sample(paced=False):
                    return Reply(False, "not done: the node is shutting down")
            except NoAnswer as none:
                return Reply(False, f"not done, no controller answers: {none}")
            except RunStopped as stopped:
                self._fail(str(stopped))
                return Reply(False, self._status)
            if self.complete:
                self._rest(Phase.FINISHED)
                break
        return Reply(True, f"at {self.simulation.time_ns / 1e9:.9f} s")

    def reset(self) -> Reply:
        """Go back to the scene's initial state.

        Stamps go on, the command is forgotten.
        """
        self._original.reset()
        self.fault = ""
        self.restart(self._original)
        self.counters.resets += 1
        if self.phase is not Phase.PAUSED:
            self._to(Phase.WAITING)
        return Reply(True, f"at the initial state, {self.phase.value}")

    def halt(self) -> Reply:
        """Go back to the initial state and pause there, also out of a fault.

        As two requests a run that waits for nothing would begin between them.
        """
        if self.phase is not Phase.FAULT:
            self._rest(Phase.PAUSED)
        self.reset()
        self._to(Phase.PAUSED)
        return Reply(True, f"at the initial state, {self.phase.value}")

    def set_state(self, gamma: Vector3, gamma_dot: Vector3) -> Reply:
        """Put a run that waits or is paused into another state [rad], [rad/s]."""
        if self.phase not in (Phase.WAITING, Phase.PAUSED):
            return Reply(
                False, f"refused: pause or reset first, the run is {self._status}"
            )
        try:
            self.restart(
                self._build(with_initial(self._original.scene, (gamma, gamma_dot)))
            )
        except SstError as error:
            return Reply(False, f"refused: {error}")
        self.warm_up()
        self.counters.states_set += 1
        return Reply(True, f"the state is set, {self.phase.value}")

    def _serve(self, *, refuses: bool = False) -> None:
        """Serve what has been requested, or refuse it."""
        self.requested.clear()
        while self._requests:
            request, pending = self._requests.popleft()
            if pending.set_running_or_notify_cancel():
                reply = _NOT_DONE
                try:
                    reply = _NOT_DONE if refuses else request() or Reply(True, "")
                finally:
                    pending.set_result(reply)

    def _start(self, waits: bool) -> bool:
        """Start the run, unless it has to wait, also for a command.

        Return whether it runs.
        """
        if self._missing_since is not None:  # of subscribers that have to be there once
            if missing := self._output.missing_subscribers():
                if (
                    time.monotonic() - self._missing_since
                    > self._run.subscriber_timeout
                ):
                    reason = (
                        f"within {self._run.subscriber_timeout:g} s"
                        " (wait_for_subscribers)"
                    )
                    self.failed = True
                    raise NoAnswer(f"no subscriber of {', '.join(missing)} {reason}")
                return False
            self._missing_since = None
        if (waits and not self._input.starts_run()) or not self.begin():
            return False
        self._resume()
        return True

    def _resume(self) -> None:
        self._to(Phase.RUNNING)
        self.resume()

    def _rest(self, phase: Phase) -> None:
        self.publish_rest()
        self._to(phase)

    def _fail(self, reason: str) -> None:
        """Latch a fault; the last valid state is published, then held."""
        self.fault = self.fault or reason
        self.failed = self.failed or self._run.last_tick < sys.maxsize
        if self.phase is not Phase.FAULT:
            self.publish_rest()
        self._to(Phase.FAULT)

    def _to(self, phase: Phase) -> None:
        if phase is not Phase.RUNNING:
            self.counters.hold()
        if phase is not self.phase:
            self.phase = phase
            self._output.publish_phase(self._status)

    @property
    def _status(self) -> str:
        return f"{self.phase.value}: {self.fault}" if self.fault else self.phase.value


OK, WARN, ERROR = range(3)
_ROWS = 32

GAUGES = {
    "error_estimate": "estimated error of the orientation [rad]",
    "rate_error_estimate": "estimated error of the body rate [rad/s]",
    "hold_error_start": (
        "estimated error of the orientation from holding torques [rad], where "
        "they are those of the start of their hold"
    ),
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
    "tick_time_left": (
        "share of a tick's period that its step leaves, mean, at real-time factor 1"
    ),
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
    "cpu_dma_latency": (
        "largest exit latency of idle states that the machine was asked to use"
    ),
}

KEYS = {**_COUNTS, **GAUGES, "fault": "reason why the run stopped"}
"""Keys of /diagnostics, in order."""


class RunDiagnostics:
    """Collects the counters of the parts of the node."""

    def __init__(self, loop: RunLoop) -> None:
        self._loop = loop
        self.gauges: dict[str, object] = {}
        self.granted = {"scheduling": "", "cpu_dma_latency": scheduling.NO_LIMIT}
        self._noted: dict[str, Any] = {}
        self._warned: list[str] = []
        # by simulated time [s]
        self._rows: dict[float, tuple[list[object], float, int]] = {}

    def values(self, publishers: int) -> dict[str, Any]:
        """Return the value of each key that has one."""
        count, (run, commands, pacer, _) = self._loop.counters, self._loop.parts
        period, ticks, wall = run.period_ns / NANOSECONDS, count.ticks, count.wall_s
        age, new = commands.age, ticks - self._noted.get("ticks", 0)
        passed = wall - self._noted.get("wall_time_s", 0.0)
        mean, most = count.step_mean_s, count.step_max_s
        factor = ticks * period / wall if wall else 0.0
        factor_now = new * period / passed if passed > 0 else 0.0
        dropped = ", ".join(
            f"{reason} {times}" for reason, times in dict(commands.reasons).items()
        )
        row = (
            *(self._loop.phase.value, ticks, pacer.missed, pacer.overruns, pacer.jumps),
            *(
                count.published,
                1e6 * mean,
                1e6 * most,
                1.0 - mean / period,
                1.0 - most / period,
            ),
            *(*count.lateness_us, factor, factor_now, wall, ticks * period),
            *(
                commands.received,
                commands.dropped,
                dropped,
                commands.clamped,
                commands.timeouts,
            ),
            *(
                "none" if age is None else age,
                publishers,
                count.resets,
                count.states_set,
            ),
            *self.granted.values(),
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

    def status(
        self, values: dict[str, Any], warnings: list[str]
    ) -> tuple[int, str, list[str]]:
        """Return the level, the status in a few words, and what is new to warn of.

        Values are as `values` has just read them. What the thread of the run counts
        meanwhile is reported the next time: words and values of one message never
        contradict each other. Warnings are of the graph.
        """
        running, fault = values["phase"] == Phase.RUNNING.value, values["fault"]
        commands = self._loop.parts.torque_input
        said = {
            "commands_dropped": f"command dropped: {commands.last_refusal}",
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
        if commands.stale and running:
            doubts.append("the command is too old")
        if fault:
            return ERROR, fault, news
        text = values["phase"]
        if running and values["command_age_s"] == "none":
            text += ", no command yet: zero torque"
        return (
            (WARN, f"{text}; {'; '.join(doubts)}", news) if doubts else (OK, text, news)
        )

    def table(self) -> Iterator[str]:
        """Yield the lines of the table of error against run time."""
        columns = "{:>12} {:>11} {:>11} {:>11} {:>10} {:>8}"
        yield columns.format(
            "run time", "error", "energy", "closure", "real-time", "ticks"
        )
        yield columns.format("[s]", "[rad]", "[J]", "[1]", "factor", "missed")
        for seconds, (errors, factor, missed) in self._rows.items():
            cells = (
                f"{value:.2e}" if isinstance(value, float) else "-" for value in errors
            )
            yield columns.format(f"{seconds:.3f}", *cells, f"{factor:.3f}", missed)


def read_gauges(simulation: Simulation, held: HeldTorques) -> dict[str, object]:
    """Read the gauges in the thread of the run.

    Those without a finite value are left out.
    """
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
    return {
        key: x for key, x in known.items() if isinstance(x, str) or math.isfinite(x)
    }
