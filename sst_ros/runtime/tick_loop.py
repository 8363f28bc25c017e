# SPDX-License-Identifier: Apache-2.0
"""The course of a run: the ticks from one published sample to the next. No ROS types in here."""

from __future__ import annotations

import contextlib
import math
import threading
import time

from sst_ros.errors import SstError
from sst_ros.runtime.counters import Counters
from sst_ros.runtime.pacing import Pacer
from sst_ros.runtime.run_types import Audience
from sst_ros.runtime.torque_input import CommandBoard, Settings
from sst_ros.simulation import Simulation, Triple

_POLL_S = 0.001
_TICKS_AT_ONCE = 64
"""So many ticks may pass before somebody who asks to stop is heard."""


class NoAnswer(SstError):
    """Nobody has answered a sample in lockstep."""


class Course:
    """Ticks and samples; owned by the run's thread.

    Attributes:
        simulation: what is run; its `state` may be read by any thread.
        begun: the first sample has been published.
        counters: what has been done.
        asked, stop: set by others to have the thread look up, or end.

    """

    def __init__(
        self,
        simulation: Simulation,
        settings: Settings,
        board: CommandBoard,
        pacer: Pacer,
        audience: Audience,
    ) -> None:
        self.simulation, self.begun, self.counters = simulation, False, Counters()
        self.asked, self.stop = threading.Event(), threading.Event()
        self._settings, self._board = settings, board
        self._pacer, self._audience = pacer, audience
        self._lockstep = settings.parameters.sync == "lockstep"
        self._period_ns = settings.parameters.period_ns
        self._ticks_per_sample = settings.parameters.ticks_per_sample
        duration = settings.parameters.duration * settings.parameters.rate
        self._last_tick = math.ceil(duration - 1e-6) or math.inf
        self._tick = self._start_ns = self._stamp_ns = 0
        self._awaited_since = time.monotonic()

    def start_anew(self, simulation: Simulation) -> None:
        """Take another simulation, or the same at its start; stamps go on."""
        self.simulation, self.begun, self._tick = simulation, False, 0
        self._board.clear()

    def begin(self) -> bool:
        """Publish the first sample; False as long as the clock has not begun."""
        self._start_ns = self._audience.begin_ns(
            self._stamp_ns + self._period_ns * self._ticks_per_sample
        )
        if self._start_ns == 0:
            return False
        self.begun = True
        self._publish()
        return True

    def refresh(self) -> None:
        """Count the age of the command and the wait for an answer from now on."""
        self._awaited_since = time.monotonic()
        self._board.refresh()

    def resume(self) -> None:
        """Count time and deadlines from now on."""
        self.refresh()
        self.counters.resume()
        self._pacer.start()

    @property
    def is_over(self) -> bool:
        """Whether the run has its duration."""
        return self._tick >= self._last_tick

    def to_the_next_sample(self, *, paced: bool) -> bool:
        """Tick to the next sample and publish it; False if something else comes first.

        Ticks between which nothing can change are done at once: in lockstep, without deadlines,
        and when a paused run is stepped.

        Raises:
            RunStopped: the run ends before; the ticks before it are done and told.
            NoAnswer: in lockstep nobody has answered in time.

        """
        answer = self._answered(paced) if self._lockstep else None
        if self._lockstep and answer is None:
            return False
        at_once = answer is not None or not paced or self._pacer.speed == 0.0
        while True:
            ticks = self._ticks_left() if at_once else 1
            if paced and not self._pacer.wait(self.stop.is_set, ticks):
                return False
            torque = self._board.torque(self.simulation) if answer is None else answer
            self._advance(torque, 1 if self._board.brakes else ticks)
            if self._tick % self._ticks_per_sample == 0 or self.is_over:
                self._publish()
                return True

    def publish_rest(self) -> None:
        """Publish what has been done since the last sample, if anything."""
        if self.begun and self._tick % self._ticks_per_sample:
            with contextlib.suppress(Exception):  # publishing may be what failed
                self._publish()

    def show(self, *, still: bool) -> None:
        """Show the state of a run that does not move."""
        self._audience.idle(self.simulation.state, still=still)

    def _ticks_left(self) -> int:
        left = self._ticks_per_sample - self._tick % self._ticks_per_sample
        return int(min(left, self._last_tick - self._tick, _TICKS_AT_ONCE))

    def _advance(self, torque: Triple, ticks: int) -> None:
        simulation, moment = self.simulation, self._board.moment
        before, began = simulation.time_ns, time.perf_counter()
        try:
            simulation.steps(torque, self._period_ns, ticks, moment)
        finally:
            took = time.perf_counter() - began
            done = (simulation.time_ns - before) // self._period_ns
            if done:
                self.counters.stepped(took, self._pacer.late_ns, done)
                self._audience.ticks(torque, moment, done)
                self._tick += done

    def _answered(self, paced: bool) -> Triple | None:
        """Torques that answer the last sample; None if something else comes first."""
        timeout = self._settings.parameters.lockstep_timeout or math.inf
        while (answer := self._board.answer(self._stamp_ns)) is None:
            if self.stop.is_set() or (paced and self.asked.is_set()):
                return None
            waited = time.monotonic() - self._awaited_since
            if waited > timeout:
                raise NoAnswer(
                    f"no command answered the sample of {self._stamp_ns} ns within {timeout:g} s"
                )
            time.sleep(min(max(waited / 10, 2e-5), _POLL_S))
        self._pacer.excuse(self._ticks_left())  # to wait for an answer is no overrun
        return answer

    def _publish(self) -> None:
        self._stamp_ns = self._start_ns + self._tick * self._period_ns
        self._audience.sample(self.simulation, self._stamp_ns)
        self._awaited_since = time.monotonic()
        self.counters.published += 1
