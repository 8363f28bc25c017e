# SPDX-License-Identifier: Apache-2.0
"""What a run loop is in, is asked, and tells; no ROS types in here."""

from __future__ import annotations

import threading
from enum import Enum
from typing import NamedTuple, Protocol

from sst_ros.runtime.torque_input import Moving
from sst_ros.simulation import State, Triple


class Phase(str, Enum):
    """What the run does."""

    WAITING = "waiting"
    RUNNING = "running"
    PAUSED = "paused"
    FAULT = "fault"
    FINISHED = "finished"


class Reply(NamedTuple):
    """What came of a request."""

    success: bool
    message: str


class Audience(Protocol):
    """Who is told: the topics."""

    def begin_ns(self, earliest_ns: int) -> int:
        """Give the stamp of a new start, not before `earliest_ns`; 0 where there is no time yet."""

    def ticks(self, torque: Triple, moment: Triple, count: int) -> None:
        """Note what acted over some ticks."""

    def sample(self, moving: Moving, stamp_ns: int) -> None:
        """Publish a sample of the run and the torques that led to it."""

    def idle(self, state: State, *, still: bool) -> None:
        """Show a state that is no sample: stamped zero, `still` with zero rates."""

    def changed(self, phase: str) -> None:
        """Tell a change of the phase, and why."""


class Answer:
    """Where the reply to a request will be."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.reply = Reply(False, "not done: the run has ended or failed")
