# SPDX-License-Identifier: Apache-2.0
"""What the page shows and what its controls act on: a running simulator, or a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import Triple


@dataclass(frozen=True)
class ViewState:
    """The manipulator at one instant.

    Attributes:
        time: of the run [s]; None for a state that is shown while there is no run.
        gamma, mu, beta: joint angles [rad], by leg.
        gamma_dot: rates of the actuators [rad/s].
        torque: at the actuators, over the step that ended [N m].

    """

    time: float | None
    gamma: Sequence[float]
    mu: Sequence[float]
    beta: Sequence[float]
    gamma_dot: Sequence[float]
    torque: Sequence[float]


@dataclass(frozen=True)
class RunStatus:
    """Phase and diagnostics of a run.

    Attributes:
        phase: of the run, or of the playback.
        level: 0 OK, 1 warning, 2 error, as in diagnostic_msgs.
        message: reason of the level.
        values: diagnostics by key.

    """

    phase: str = ""
    level: int = 0
    message: str = ""
    values: dict[str, str] = field(default_factory=dict)


class ViewSource(Protocol):
    """Where the page takes its data from; called from the page's thread."""

    @property
    def scene(self) -> Scene | None:
        """The scene; None while it is unknown."""

    def states(self) -> Sequence[ViewState]:
        """Return the states since the last call, in order of time."""

    def status(self) -> RunStatus:
        """Return the latest status of the run."""


class RunControl(ViewSource, Protocol):
    """A run that can be paused and driven; requests return success and a message."""

    def pause(self, paused: bool) -> tuple[bool, str]:
        """Pause or resume the run."""

    def step(self) -> tuple[bool, str]:
        """Advance a paused run by one sample."""

    def reset(self) -> tuple[bool, str]:
        """Return to the initial state."""

    def apply(self, torque: Triple) -> None:
        """Hold torques [N m] from now on."""

    def controller(self) -> str:
        """Name of another node that commands the run; empty if there is none."""


@runtime_checkable
class Playback(ViewSource, Protocol):
    """A recording that can be played."""

    @property
    def length(self) -> float:
        """Its length [s]."""

    @property
    def playing(self) -> bool:
        """Whether it is playing."""

    def play(self, playing: bool) -> None:
        """Play or pause; play from the beginning at the end."""

    def seek(self, time: float) -> None:
        """Go to a time [s]."""

    def set_speed(self, factor: float) -> None:
        """Set recorded time per time."""
