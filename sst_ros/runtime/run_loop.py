# SPDX-License-Identifier: Apache-2.0
"""State machine of a run: waiting, running, paused, fault, finished.

One thread owns it. Other threads send requests by `ask`, which are served between two
samples, in the thread of the run.
"""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from sst_ros.errors import RunStopped, SstError
from sst_ros.runtime.tick_loop import (
    IDLE_PERIOD_S,
    NoAnswer,
    RunParts,
    TickLoop,
)
from sst_ros.scene.scene import Scene, with_initial
from sst_ros.simulation.simulation import Simulation
from sst_ros.state import Vector3

_POLL_S = 0.001
"""Longest sleep of a run that waits, and between two looks for a reply."""
_LONGEST_REPLY_S = 30.0
"""Longest wait for a reply: a step of a stiff scene may take seconds."""


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
        self.phase = Phase.WAITING
        self.fault = ""  # why the run stopped, until a reset
        self.failed = False  # the fault ends the node: nothing is left to wait for
        self._build = build
        self._original = build(scene)
        super().__init__(self._original, parts)
        self._requests: deque[tuple[Callable[[], Reply | None], Future[Reply]]] = (
            deque()
        )
        self._missing_since: float | None = time.monotonic()

    def ask(self, request: Callable[[], Reply]) -> Reply:
        """Have a request (`pause`, `reset`, ...) served by the thread of the run.

        Wait for its reply; the wait ends early where the run has stopped. The time that
        the run takes to load its code, which a busy machine makes long, does not count.
        """
        pending = self.post(request)
        waits_since = time.monotonic()
        while not wait([pending], _POLL_S).done:
            if self.loading:
                waits_since = time.monotonic()
            reason = ""
            if self.stopped.is_set():
                reason = self.fault or "the node is ending"
            elif time.monotonic() - waits_since > _LONGEST_REPLY_S:
                reason = f"the run did not reply within {_LONGEST_REPLY_S:g} s"
            if reason and not pending.done():  # it may have been served just before
                pending.cancel()
                return Reply(False, f"not done: {reason}")
        return pending.result()

    def post(self, request: Callable[[], Reply | None]) -> Future[Reply]:
        """Have a request served, without waiting for it.

        It has succeeded where it gives no reply.
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
        is_warm = False
        last_shown_s = -math.inf
        while not (
            self.stopped.is_set() or self.phase is Phase.FINISHED or self.failed
        ):
            try:
                if not is_warm:
                    is_warm = True
                    self.warm_up()
                if self.requested.is_set():
                    self._serve()
                if self.phase is Phase.WAITING and not self._start(self._run.waits):
                    if time.monotonic() - last_shown_s > IDLE_PERIOD_S:
                        last_shown_s = time.monotonic()
                        self.show(fault=False, waits=True)
                    time.sleep(_POLL_S)
                elif self.phase is Phase.RUNNING:
                    has_sample = self.to_next_sample(paced=True)
                    if has_sample and self.complete:
                        self._stop_in(Phase.FINISHED)
                elif self.phase in (Phase.PAUSED, Phase.FAULT):
                    self.show(fault=bool(self.fault))
                    self.requested.wait(IDLE_PERIOD_S)
            except (RunStopped, NoAnswer) as stopped:
                self._fail(str(stopped))
            except Exception as error:
                frame = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{Path(frame.filename).name}:{frame.lineno}"
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
            self._stop_in(Phase.PAUSED)
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
        """Advance a paused run by some samples with the torques of the last command."""
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
                self._stop_in(Phase.FINISHED)
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
            self._stop_in(Phase.PAUSED)
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
            if not pending.set_running_or_notify_cancel():
                continue
            reply = _NOT_DONE
            try:
                if not refuses:
                    reply = request() or Reply(True, "")
            finally:
                pending.set_result(reply)

    def _start(self, waits: bool) -> bool:
        """Start the run and return whether it runs.

        It has to wait for the subscribers of the parameters, and with `waits` for a
        command, too.
        """
        if not self._has_subscribers():
            return False
        if waits and not self._input.starts_run():
            return False
        if not self.begin():
            return False
        self._resume()
        return True

    def _has_subscribers(self) -> bool:
        """Return whether all subscribers that have to be there once have been there.

        Raises:
            NoAnswer: they have not within subscriber_timeout; the node ends by that.

        """
        if self._missing_since is None:
            return True
        missing = self._output.missing_subscribers()
        if not missing:
            self._missing_since = None
            return True
        timeout = self._run.subscriber_timeout
        if time.monotonic() - self._missing_since > timeout:
            self.failed = True
            reason = f"within {timeout:g} s (wait_for_subscribers)"
            raise NoAnswer(f"no subscriber of {', '.join(missing)} {reason}")
        return False

    def _resume(self) -> None:
        self._to(Phase.RUNNING)
        self.resume()

    def _stop_in(self, phase: Phase) -> None:
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
