# SPDX-License-Identifier: Apache-2.0
"""What the page shows and its controls act on: a running simulator or a recording."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from sst_ros.runtime import child_process
from sst_ros.scene.loads import JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.state import Vector3

_PUBLISH_RATE = 100
"""Rate of a simulator that is only looked at [Hz]: more than a screen shows."""


class ViewState(NamedTuple):
    """The manipulator at one instant, by leg."""

    # of the run [s]; None for a state that is shown while there is no run
    time: float | None
    gamma: Sequence[float]  # [rad]
    mu: Sequence[float]
    beta: Sequence[float]
    gamma_dot: Sequence[float]  # [rad/s]
    torque: Sequence[float]  # at the actuators, over the step that ended [N m]

    @property
    def angles(self) -> dict[str, float]:
        """Angle of each joint by its name [rad]."""
        return dict(zip(JOINTS, (*self.gamma, *self.mu, *self.beta), strict=True))


@dataclass(frozen=True)
class RunStatus:
    """Phase and diagnostics of a run, or of the playback."""

    phase: str = ""
    level: int = 0  # 0 OK, 1 warning, 2 error, as in diagnostic_msgs
    message: str = ""  # the reason of the level
    values: dict[str, str] = field(default_factory=dict)


class RunControl(Protocol):
    """A run that is shown, paused and driven; called from the page's thread."""

    @property
    def scene(self) -> Scene | None:
        """The scene; None while it is unknown."""

    def states(self) -> Sequence[ViewState]:
        """Return the states since the last call, in order of time."""

    def status(self) -> RunStatus:
        """Return the latest status of the run."""

    def ask(self, request: str) -> tuple[bool, str]:
        """Ask to pause, resume, step (a paused run by one sample) or reset.

        Return whether that was done, and the reply.
        """

    def apply(self, torque: Vector3) -> None:
        """Hold torques [N m] from now on."""

    def controller(self) -> str:
        """Name of another node that commands the run; empty if there is none."""


class Replay:
    """Plays a bag of `length` [s]; has `scene`, `states` and `status` as a run.

    The namespace is that of `read_bag`. It is used from two threads of the page. Raises
    InputError where the bag is no whole recording.
    """

    def __init__(self, bag: Path, namespace: str | None = None) -> None:
        # needs rosbags, which a live view does not
        from sst_ros.recording.recording import read

        self._run = read(bag, namespace=namespace)
        self.scene = self._run.scene
        self._seconds = self._run.seconds
        self.length = float(self._seconds[-1])
        self._lock = threading.Lock()
        self._time = 0.0  # of the recording [s]
        self._since = time.monotonic()  # when `_time` was set
        self._factor = 1.0
        self.playing = True
        self._sent = -1  # row of the last state that was returned

    def play(self, playing: bool) -> None:
        """Play or pause; play from the beginning at the end."""
        with self._advance():
            if playing and self._time >= self.length:
                self._time = 0.0
            self.playing = playing

    def seek(self, time: float) -> None:
        """Go to a time [s]."""
        with self._advance():
            self._time = min(max(time, 0.0), self.length)

    def set_speed(self, factor: float) -> None:
        """Set recorded time per time."""
        with self._advance():
            self._factor = factor

    def states(self) -> Sequence[ViewState]:
        """Return the states up to now, from the beginning after a jump back."""
        with self._advance():
            time = self._time
        # a sample at this time counts, whatever the rounding of both
        later_row = int(np.searchsorted(self._seconds, time + 1e-9, side="right"))
        row = max(later_row - 1, 0)
        first = self._sent + 1 if row >= self._sent else 0
        self._sent = row
        run = self._run
        columns = (run.gamma, run.mu, run.beta, run.gamma_dot, run.effort)
        states = []
        for i in range(first, row + 1):
            numbers = (column[i] for column in columns)
            states.append(ViewState(float(self._seconds[i]), *numbers))
        return states

    def status(self) -> RunStatus:
        """Return the last diagnostics of the recording."""
        values = self._run.diagnostics
        fault = values.get("fault", "")
        phase = "recording" if self.playing else "recording, paused"
        return RunStatus(phase, 2 if fault else 0, fault, values)

    @contextmanager
    def _advance(self) -> Iterator[None]:
        """Hold the lock, with the time of the recording at what it is now."""
        with self._lock:
            now = time.monotonic()
            if self.playing:
                played = (now - self._since) * self._factor
                self._time = min(self._time + played, self.length)
                self.playing = self._time < self.length
            self._since = now
            yield


def run_simulator(
    scene: str, speed: float = 1.0
) -> AbstractContextManager[subprocess.Popen[str]]:
    """Run a simulator of a scene to look at; `speed` is simulated time per time."""
    parameters = {
        "scene": scene,
        "publish_rate": _PUBLISH_RATE,
        "real_time_factor": speed,
    }
    return child_process.run_beside("simulator", parameters, stdout=subprocess.DEVNULL)
