# SPDX-License-Identifier: Apache-2.0
"""Runs of the tick loop of the simulator node, without ROS and as fast as possible."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sst_ros.runtime.pacing import Pacer, RunSettings, SteadyTime
from sst_ros.runtime.tick_loop import TickLoop
from sst_ros.runtime.torque_input import ZERO, HasState
from sst_ros.simulation.simulation import NANOSECONDS, Simulation, State

TorqueOf = Callable[[Simulation], Any]
"""Torques of the tick that begins now [N m], constant or a `SineTorque`."""


class FunctionRun:
    """Input and output of a run whose torques come from a function instead of messages.

    Attributes:
        states: those of all samples.
        times: processor time of the thread at each [s].

    """

    moment, unread = ZERO, False

    def __init__(self, torque: TorqueOf) -> None:
        self._torque = torque
        self.states: list[State] = []
        self.times: list[float] = []

    def torque(self, simulation: Simulation, _: int) -> Any:
        """Return the torques of the tick that begins now."""
        return simulation.acting(self._torque(simulation))

    def constant(self, _: int) -> bool:
        """Return that the torques of the last tick do not act any longer."""
        return False

    def now_ns(self) -> int:
        """Return any time but zero, which means that there is none."""
        return NANOSECONDS

    def sample(self, simulation: HasState, _: int) -> None:
        """Keep the state."""
        self.states.append(simulation.state)
        self.times.append(time.thread_time())

    def _nothing(self, *_: Any) -> None:
        """Do nothing: no command gets old, and there is nothing to publish to."""

    refresh = start = ticks = _nothing


def run_in_loop(
    simulation: Simulation, torque: TorqueOf, period_ns: int, ticks: int, *, warm: bool = False
) -> FunctionRun:
    """Run a simulation from its start for some ticks, with a sample at each.

    With `warm` the code of all methods is loaded before, so that all ticks take equally long.

    Raises:
        RunStopped: it ended before.

    """
    run: Any = FunctionRun(torque)
    settings, pacer = RunSettings(period_ns, last_tick=ticks), Pacer(period_ns, 0.0, SteadyTime())
    loop = TickLoop(simulation, settings, run, pacer, run)
    if warm:
        loop.warm_up()
    loop.begin()
    loop.resume()
    while not loop.complete:
        loop.to_next_sample(paced=True)
    done: FunctionRun = run
    return done
