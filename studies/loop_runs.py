# SPDX-License-Identifier: Apache-2.0
"""Runs of the run loop of the simulator node, without ROS and as fast as possible.

There is a sample at every tick. The torques come from a function instead of messages.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from sst_ros.runtime.pacing import Pacer, SteadyTime
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.settings import RunSettings
from sst_ros.runtime.torque_input import HasState, TorqueInput
from sst_ros.scene.scene import Scene
from sst_ros.simulation.simulation import NANOSECONDS, Simulation, State

TorqueOf = Callable[[Any], Any]
"""Torques of the tick that begins now [N m], constant or a `SineTorque`, from the simulation."""

_LONGEST_S = 120.0


class _NoMessages:
    waiting = False

    def arrived(self, until_ns: float) -> tuple[()]:
        return ()


class FunctionInput(TorqueInput):
    """Torque input that calls a function at every tick."""

    def __init__(self, run: RunSettings, scene: Scene, torque: TorqueOf) -> None:
        super().__init__(run, scene.actuators, _NoMessages(), _NoMessages())
        self._torque_of = torque

    def torque(self, simulation: Any, now_ns: int) -> Any:
        """Return the torques of the tick that begins now."""
        return simulation.acting(self._torque_of(simulation))


class LoopOutput:
    """Keeps the states of all samples, and the processor time of the thread at each."""

    unread = False

    def __init__(self) -> None:
        self.states: list[State] = []
        self.times: list[float] = []

    def now_ns(self) -> int:
        """Return any time but zero, which means that there is none."""
        return NANOSECONDS

    def missing_subscribers(self) -> list[str]:
        """Return no topic: there are no subscribers to wait for."""
        return []

    def sample(self, simulation: HasState, stamp_ns: int) -> None:
        """Keep the state."""
        self.states.append(simulation.state)
        self.times.append(time.thread_time())

    def _nothing(self, *_: Any, **__: Any) -> None:
        """Do nothing: there is nothing to publish to."""

    start = ticks = flush = idle = phase_changed = _nothing


def run_in_loop(
    scene: Scene,
    build: Callable[[Scene], Simulation],
    torque: TorqueOf,
    period_ns: int,
    ticks: int,
) -> tuple[RunLoop, LoopOutput]:
    """Run the run loop for some ticks in a thread of its own.

    Args:
        scene: what is simulated.
        build: makes the simulation of a scene.
        torque: torques of a tick.
        period_ns: length of a tick [ns].
        ticks: how many.

    Returns:
        The loop, finished or with a fault, and what it has published.

    """
    run, output = RunSettings(period_ns, last_tick=ticks), LoopOutput()
    pacer = Pacer(period_ns, 0.0, SteadyTime())
    loop = RunLoop(scene, build, run, FunctionInput(run, scene, torque), pacer, output)
    thread = threading.Thread(target=loop.run, daemon=True)
    thread.start()
    thread.join(_LONGEST_S)
    loop.stop()
    thread.join(1.0)
    return loop, output
