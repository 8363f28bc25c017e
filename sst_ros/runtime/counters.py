# SPDX-License-Identifier: Apache-2.0
"""Counters of a run: written by its thread, read by the diagnostics."""

from __future__ import annotations

import math
import time


class Counters:
    """Counters of a run.

    Attributes:
        ticks, published: steps done and samples published.
        resets, states_set: number of resets and of states set.
        step_total_s, step_max_s: total time of the steps and longest mean time of one [s].

    """

    def __init__(self) -> None:
        self.ticks = self.published = self.resets = self.states_set = 0
        self.step_total_s = self.step_max_s = 0.0
        self._late_total = self._late_square = self._late_max = 0.0
        self._wall_s = 0.0
        self._resumed: float | None = None

    def resume(self) -> None:
        """Count running time from now on."""
        self.hold()
        self._resumed = time.monotonic()

    def hold(self) -> None:
        """Stop to count running time."""
        if self._resumed is not None:
            self._wall_s += time.monotonic() - self._resumed
            self._resumed = None

    def stepped(self, took_s: float, late_ns: int, ticks: int = 1) -> None:
        """Count steps of one call: their time [s] and the lateness of their start [ns]."""
        self.ticks += ticks
        self.step_total_s += took_s
        if took_s > self.step_max_s * ticks:
            self.step_max_s = took_s / ticks
        late = 1e-3 * late_ns
        self._late_total += late * ticks
        self._late_square += late * late * ticks
        if late > self._late_max:
            self._late_max = late

    @property
    def wall_s(self) -> float:
        """Time spent running [s]."""
        resumed = self._resumed
        return self._wall_s + (time.monotonic() - resumed if resumed is not None else 0.0)

    @property
    def step_mean_s(self) -> float:
        """Mean time of a step [s]."""
        return self.step_total_s / max(self.ticks, 1)

    @property
    def lateness_us(self) -> tuple[float, float, float]:
        """Mean, standard deviation and largest lateness of the ticks [us]."""
        count = max(self.ticks, 1)
        mean = self._late_total / count
        variance = max(self._late_square / count - mean * mean, 0.0)
        return mean, math.sqrt(variance), self._late_max
