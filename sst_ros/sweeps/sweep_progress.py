# SPDX-License-Identifier: Apache-2.0
"""Progress of a study: rows a second, time left, and how many runs ended early, by reason."""

from __future__ import annotations

import sys
import time
from collections import Counter

from sst_ros.sweeps.chunk_task import ChunkOutcome

_EVERY = 0.2
"""Least time between two lines on a terminal [s]."""


class SweepProgress:
    """A line that is drawn over itself on a terminal; silent elsewhere.

    Args:
        total: rows of the study.
        done: rows that are there already.
        shown: draw at all.

    """

    def __init__(self, total: int, done: int, *, shown: bool) -> None:
        self._total, self._before, self._done = total, done, done
        self._began, self._drawn = time.monotonic(), 0.0
        self._shown = shown and sys.stderr.isatty()
        self.reasons: Counter[str] = Counter()

    def add(self, outcome: ChunkOutcome) -> None:
        """Count a chunk that is done."""
        self._done += outcome.rows
        self.reasons.update(dict(outcome.reasons))
        now = time.monotonic()
        if self._shown and (now - self._drawn > _EVERY or self._done == self._total):
            self._drawn = now
            end = "\n" if self._done == self._total else ""
            print(f"\r{self.line()[:110]:110}", end=end, file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """Print a message above the line."""
        if self._shown:
            print(f"\r{' ' * 110}\r", end="", file=sys.stderr)
        print(f"sweep: {text}", file=sys.stderr, flush=True)

    def line(self) -> str:
        """Return the line."""
        seconds = max(time.monotonic() - self._began, 1e-9)
        rate = (self._done - self._before) / seconds
        left = (self._total - self._done) / rate if rate else float("inf")
        bar = "#" * (20 * self._done // self._total)
        ended = ", ".join(f"{count} {text}" for text, count in self.reasons.most_common(3))
        early = f"; early: {ended}" if ended else ""
        return f"[{bar:20}] {self._done}/{self._total} runs, {rate:.0f}/s, {left:.0f} s left{early}"
