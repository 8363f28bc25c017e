# SPDX-License-Identifier: Apache-2.0
"""What the page shows and what its buttons act on: a running simulator, or a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from sst_ros.scene.scene import Scene
from sst_ros.simulation import Triple


@dataclass(frozen=True)
class Sample:
    """One instant.

    Attributes:
        time: of the run [s]; None for a state that is shown while there is no run.
        gamma, mu, beta: angles [rad] by leg.
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
class Health:
    """What the run says about itself: its phase, the keys of its diagnostics, whether all is well.

    `level` is 0 for good, 1 for a warning, 2 for an error, as in diagnostic_msgs; `said` tells why.
    """

    phase: str = ""
    level: int = 0
    said: str = ""
    values: dict[str, str] = field(default_factory=dict)


class Source(Protocol):
    """Where the page takes what it shows; called from the page's thread."""

    @property
    def scene(self) -> Scene | None:
        """The scene; None as long as it is not known."""

    def samples(self) -> Sequence[Sample]:
        """Give what is new since the last call, in order of time."""

    def health(self) -> Health:
        """Give the last word of the run about itself."""

    def controls(self) -> Controls | Reel:
        """Give what the buttons act on."""


class Controls(Protocol):
    """A run that can be held and driven; each returns what came of it, whether done and words."""

    def pause(self, paused: bool) -> tuple[bool, str]:
        """Hold the run, or let it go on."""

    def step(self) -> tuple[bool, str]:
        """Advance a held run by one sample."""

    def reset(self) -> tuple[bool, str]:
        """Go back to the initial state."""

    def drive(self, torque: Triple) -> None:
        """Hold torques [N m] from now on."""

    def driven_by(self) -> str:
        """Name the controller that drives the run; empty where there is none."""


@runtime_checkable
class Reel(Protocol):
    """A recording that can be played."""

    @property
    def length(self) -> float:
        """Its length [s]."""

    @property
    def playing(self) -> bool:
        """Whether it runs."""

    def play(self, playing: bool) -> None:
        """Run or hold it; from the beginning where it has ended."""

    def seek(self, time: float) -> None:
        """Go to a time [s]."""

    def speed(self, factor: float) -> None:
        """Set the recorded time per time."""
