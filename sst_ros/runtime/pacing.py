# SPDX-License-Identifier: Apache-2.0
"""Ticks of a run at absolute deadlines; late ones are counted, never made up for."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

_LONGEST_SLEEP_S = 0.05
_TOGETHER_NS = 2_000_000
"""Bounds the ticks that one sleep ends in, so that few commands wait."""


@dataclass
class RunSettings:
    """Numbers of a run, of a node or not; the times may change between two ticks."""

    period_ns: int  # of a tick
    ticks_per_sample: int = 1  # from one published sample to the next: the control period
    last_tick: int = sys.maxsize  # after which the run ends, if at all
    lockstep: bool = False  # each sample is answered before the next tick
    waits: bool = False  # a command starts the run
    partial_commands: bool = False  # an effort that is nan means zero torque
    command_timeout_ns: float = 0.0  # age at which a command is no longer held; 0 for never
    lockstep_timeout: float = 0.0  # longest wait for the answer to a sample [s]; 0 for no end
    subscriber_timeout: float = 0.0  # longest wait for subscribers [s]


class TimeSource(Protocol):
    """Clock that deadlines are measured by."""

    def now_ns(self) -> int:
        """Return the time [ns]."""

    def sleep(self, seconds: float, /) -> None:
        """Wait for about this time [s]; may return early."""


class SteadyTime:
    """The monotonic clock of the machine."""

    now_ns = staticmethod(time.monotonic_ns)
    sleep = staticmethod(time.sleep)


class Pacer:
    """Deadlines anchor + k period / speed. After an overrun the whole periods in it are dropped.

    Lateness up to `tolerance_ns` is made up for: the step of a followed clock. With the speed 0,
    the real-time factor, deadlines have always come.
    """

    def __init__(
        self, period_ns: int, speed: float, source: TimeSource, tolerance_ns: int = 0
    ) -> None:
        self._period_ns, self._source, self._tolerance_ns = period_ns, source, tolerance_ns
        self._anchor = self._count = self._seen = 0
        self._set(speed)
        self.missed = self.overruns = 0  # ticks dropped, and times that some were
        self.jumps = 0  # of the clock, back
        self.late_ns = 0  # of the start of the last tick

    def start(self) -> None:
        """Begin now; the first deadline is one period away."""
        self._anchor = self._seen = self._source.now_ns()
        self._count = 1

    def change(self, speed: float) -> None:
        """Go on at another speed, without a burst."""
        self._set(speed)
        self.start()

    def _set(self, speed: float) -> None:
        self.speed, self._interval = speed, self._period_ns / speed if speed else 0.0
        self.interval_ns = round(self._interval)  # between deadlines; 0 without any
        # Ticks that one sleep may end in; a clock that is followed does not give the next deadline.
        several = speed > 0.0 and self._tolerance_ns == 0
        self.together = max(1, int(_TOGETHER_NS // self._interval)) if several else 1

    def excuse(self, ticks: int) -> None:
        """Put the deadlines off if the last of the next ticks is past: that is no overrun."""
        if self.speed > 0.0:
            self._anchor += max(0, self._source.now_ns() - self._due(ticks))

    def _due(self, ticks: int) -> int:
        """Return the deadline of the last of the next ticks [ns]."""
        return self._anchor + round((self._count + ticks - 1) * self._interval)

    def wait(self, interrupted: Callable[[], bool], ticks: int = 1) -> bool:
        """Wait for the next deadline, or the last of several; False if interrupted before.

        That is asked after each sleep, the longest of which is 50 ms.
        """
        if self.speed == 0.0:
            self.late_ns = 0
            return not interrupted()
        due, slept = self._due(ticks), False
        while True:
            now = self._source.now_ns()
            if now < self._seen:
                self.jumps += 1
                self.start()
                now, due = self._anchor, self._due(ticks)
            self._seen = now
            if (late := now - due) >= 0:
                break
            if slept and interrupted():
                return False
            self._source.sleep(min(-late / 1e9, _LONGEST_SLEEP_S))
            slept = True
        if late >= self._interval and late >= self._tolerance_ns:
            dropped = int(late // self._interval)
            self.missed += dropped
            self.overruns += 1
            self._count += dropped
        self._count += ticks
        self.late_ns = late
        return True
