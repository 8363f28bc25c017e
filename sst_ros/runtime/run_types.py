# SPDX-License-Identifier: Apache-2.0
"""Types that the run loop shares with the node: phases, replies, and where its output goes."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple, Protocol

from sst_ros.simulation.simulation import State, Triple


class Phase(str, Enum):
    """Phase of a run."""

    WAITING = "waiting"
    RUNNING = "running"
    PAUSED = "paused"
    FAULT = "fault"
    FINISHED = "finished"


class Reply(NamedTuple):
    """Answer to a request."""

    success: bool
    message: str


class PendingReply:
    """Reply that the thread of the run will give; `done` is set when `reply` is valid."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.reply = Reply(False, "not done: the run has ended or failed")


class HasState(Protocol):
    """A simulation, as far as its state is read."""

    @property
    def state(self) -> State:
        """Present state; built when it is read."""

    @property
    def sample(self) -> tuple[Sequence[float], Sequence[float], Triple]:
        """Numbers of `state`: quaternion and body rate first, nine angles and rates, torques."""


class RunOutput(Protocol):
    """Where a run publishes: the topics of the node."""

    def now_ns(self) -> int:
        """Return the ROS time [ns]; 0 as long as a followed clock has none."""

    def missing_subscribers(self) -> list[str]:
        """Return the topics whose subscribers the run has to wait for."""

    @property
    def unread(self) -> bool:
        """Whether nothing receives samples, so that only the last of several has to be made."""

    def start(self) -> None:
        """Forget the torques of the run before."""

    def ticks(self, torque: Triple, moment: Triple, count: int) -> None:
        """Log the torque [N m] and external moment [N m] of some ticks."""

    def sample(self, simulation: HasState, stamp_ns: int) -> None:
        """Publish a sample of the run, and from time to time the torques logged up to it."""

    def flush(self) -> None:
        """Publish the torques that are logged and not published."""

    def idle(self, state: State, stamp_ns: int, *, at_rest: bool) -> None:
        """Publish a state that is no sample; `at_rest` with zero rates and efforts."""

    def phase_changed(self, phase: str) -> None:
        """Publish the phase, with the reason of a fault."""
