# SPDX-License-Identifier: Apache-2.0
"""Runs of the tick loop of the simulator node, without ROS and as fast as possible.

There is a sample at every tick. The torques come from a function instead of messages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sst_ros.runtime.pacing import Pacer, SteadyTime
from sst_ros.runtime.settings import RunSettings
from sst_ros.runtime.tick_loop import TickLoop
from sst_ros.runtime.torque_input import ZERO, HasState
from sst_ros.simulation.simulation import NANOSECONDS, Simulation, State

TorqueOf = Callable[[Simulation], Any]
"""Torques of the tick that begins now [N m], constant or a `SineTorque`."""


class FunctionInput:
    """Torque input that calls a function at every tick."""

    moment = ZERO

    def __init__(self, torque: TorqueOf) -> None:
        self._torque = torque

    def torque(self, simulation: Simulation, _: int) -> Any:
        """Return the torques of the tick that begins now."""
        return simulation.acting(self._torque(simulation))

    def constant(self, _: int) -> bool:
        """Return that the torques of the last tick do not act any longer."""
        return False

    def refresh(self) -> None:
        """Do nothing: there are no commands that get old."""


class SampleStore:
    """Keeps the states of all samples, and the processor time of the thread at each."""

    unread = False

    def __init__(self) -> None:
        self.states: list[State] = []
        self.times: list[float] = []

    def now_ns(self) -> int:
        """Return any time but zero, which means that there is none."""
        return NANOSECONDS

    def sample(self, simulation: HasState, stamp_ns: int) -> None:
        """Keep the state."""
        self.states.append(simulation.state)
        self.times.append(time.thread_time())

    def _nothing(self, *_: Any) -> None:
        """Do nothing: there is nothing to publish to."""

    start = ticks = _nothing


def run_in_loop(
    simulation: Simulation, torque: TorqueOf, period_ns: int, ticks: int
) -> SampleStore:
    """Run a simulation from its start for some ticks, and keep its samples.

    Raises:
        RunStopped: it ended before.

    """
    source: Any = FunctionInput(torque)
    samples = SampleStore()
    pacer = Pacer(period_ns, 0.0, SteadyTime())
    output: Any = samples
    loop = TickLoop(simulation, RunSettings(period_ns, last_tick=ticks), source, pacer, output)
    loop.warm_up()
    loop.begin()
    loop.resume()
    while not loop.complete:
        loop.to_next_sample(paced=True)
    return samples
