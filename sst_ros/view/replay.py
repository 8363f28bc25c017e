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
from sst_ros.view.source import RunStatus, ViewState


class Replay:
    """Plays a bag; a `Playback`, used from two threads of the page.

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
        """Whether it is playing."""
        return self._playing

    def play(self, playing: bool) -> None:
        """Play or pause; play from the beginning at the end."""
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

    def set_speed(self, factor: float) -> None:
        """Set recorded time per time."""
        with self._lock:
            self._advance()
            self._factor = factor

    def states(self) -> Sequence[ViewState]:
        """Return the states up to now, from the beginning after a jump back."""
        with self._lock:
            self._advance()
            at = int(np.searchsorted(self._seconds, self._now + 1e-9, side="right")) - 1
        at = max(at, 0)
        first = self._shown + 1 if at >= self._shown else 0
        self._shown = at
        return [self._state(row) for row in range(first, at + 1)]

    def status(self) -> RunStatus:
        """Return the last diagnostics of the recording."""
        values = self._run.diagnostics
        fault = values.get("fault", "")
        phase = "recording" if self._playing else "recording, paused"
        return RunStatus(phase, 2 if fault else 0, fault, values)

    def _advance(self) -> None:
        now = time.monotonic()
        if self._playing:
            self._now += (now - self._since) * self._factor
            if self._now >= self.length:
                self._now, self._playing = self.length, False
        self._since = now

    def _state(self, row: int) -> ViewState:
        run = self._run
        return ViewState(
            float(self._seconds[row]),
            run.gamma[row],
            run.mu[row],
            run.beta[row],
            run.gamma_dot[row],
            run.effort[row],
        )
