# SPDX-License-Identifier: Apache-2.0
"""A recording as a source of the page."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sst_ros.recording import recording
from sst_ros.scene.scene import Scene
from sst_ros.view.source import Health, Sample


class Replay:
    """Plays a bag; a `Source` and its own `Reel`, for the threads of the page and of its buttons.

    Raises:
        InputError: the bag is no whole recording of a run.

    """

    def __init__(self, bag: Path) -> None:
        self._run = recording.read(bag)
        self._lock = threading.Lock()
        self._seconds = self._run.seconds
        self._now, self._since, self._factor = 0.0, time.monotonic(), 1.0
        self._playing, self._shown = False, -1
        self.play(True)

    @property
    def scene(self) -> Scene:
        """The recorded scene."""
        return self._run.scene

    @property
    def length(self) -> float:
        """Length of the run [s]."""
        return float(self._seconds[-1])

    @property
    def playing(self) -> bool:
        """Whether it runs."""
        return self._playing

    def controls(self) -> Replay:
        """Give itself: it can be played."""
        return self

    def play(self, playing: bool) -> None:
        """Run or hold it; from the beginning where it has ended."""
        with self._lock:
            self._advance()
            if playing and self._now >= self.length:
                self._now = 0.0
            self._playing = playing

    def seek(self, time: float) -> None:
        """Go to a time [s]."""
        with self._lock:
            self._advance()
            self._now = min(max(time, 0.0), self.length)

    def speed(self, factor: float) -> None:
        """Set the recorded time per time."""
        with self._lock:
            self._advance()
            self._factor = factor

    def samples(self) -> Sequence[Sample]:
        """Give the samples up to now, from the beginning after a jump back."""
        with self._lock:
            self._advance()
            at = int(np.searchsorted(self._seconds, self._now + 1e-9, side="right")) - 1
        at = max(at, 0)
        first = self._shown + 1 if at >= self._shown else 0
        self._shown = at
        return [self._sample(row) for row in range(first, at + 1)]

    def health(self) -> Health:
        """Give the last diagnostics of the recording."""
        values = self._run.diagnostics
        said = values.get("fault", "")
        phase = "recording" if self._playing else "recording, held"
        return Health(phase, 2 if said else 0, said, values)

    def _advance(self) -> None:
        now = time.monotonic()
        if self._playing:
            self._now += (now - self._since) * self._factor
            if self._now >= self.length:
                self._now, self._playing = self.length, False
        self._since = now

    def _sample(self, row: int) -> Sample:
        run = self._run
        return Sample(
            float(self._seconds[row]),
            run.gamma[row],
            run.mu[row],
            run.beta[row],
            run.gamma_dot[row],
            run.effort[row],
        )
