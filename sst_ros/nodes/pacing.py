# SPDX-License-Identifier: Apache-2.0
"""Ticks at absolute deadlines of the monotonic clock; late ones are counted, never made up for."""

from __future__ import annotations

import time


class Pacer:
    """Deadlines start + k * period. After an overrun of whole periods they are dropped."""

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self.missed = 0
        self._next = 0
        self.started_ns = 0

    def start(self) -> None:
        """Begin now; the first deadline is one period away."""
        self.started_ns = time.monotonic_ns()
        self._next = self.started_ns + self.period_ns

    def wait(self) -> None:
        """Sleep until the next deadline, or return at once and count what was missed."""
        late = time.monotonic_ns() - self._next
        if late < 0:
            time.sleep(-late / 1e9)
        else:
            dropped = late // self.period_ns
            self.missed += dropped
            self._next += dropped * self.period_ns
        self._next += self.period_ns
