# SPDX-License-Identifier: Apache-2.0
"""The services of simulation_interfaces 2.x, where that package is installed.

The same state machine as that of ~/pause, ~/step and ~/reset answers. STOPPED is a run at its
initial state that is paused. The numbers are those of the package's messages.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node

from sst_ros.nodes import topics
from sst_ros.runtime.run_loop import RunLoop
from sst_ros.runtime.run_types import Phase, Reply

try:
    from simulation_interfaces import srv
except ImportError:  # not part of every installation, nor of the wheels
    srv = None

STOPPED, PLAYING, PAUSED, QUITTING = range(4)
UNSUPPORTED, DONE, _, INCORRECT_STATE, FAILED = range(5)
ALREADY_THERE, INCORRECT_TRANSITION = 101, 103
SCOPE_TIME, SCOPE_STATE, SCOPE_SPAWNED, SCOPE_ALL = 1, 2, 4, 255
FEATURES = (20, 22, 24, 25, 26, 31, 32)
"""Reset, reset of the state, get and set the state, pause, one step, many steps."""


class SimulationInterfaces:
    """Answers the services; each takes a request and fills a response."""

    def __init__(self, loop: RunLoop) -> None:
        self._loop = loop

    def features(self, _: Any, response: Any) -> Any:
        """GetSimulatorFeatures."""
        response.features.features = list(FEATURES)
        response.features.custom_info = "sst_ros; ROS time continues over a reset"
        return response

    def get_state(self, _: Any, response: Any) -> Any:
        """GetSimulationState."""
        response.state.state = self._state()
        response.result.result = DONE
        return response

    def set_state(self, request: Any, response: Any) -> Any:
        """SetSimulationState."""
        wanted = request.state.state
        if wanted == self._state():
            response.result.result = ALREADY_THERE
        elif wanted == PAUSED and self._state() == STOPPED:
            response.result.result = INCORRECT_TRANSITION
            response.result.error_message = "a stopped simulation can be started, not paused"
        elif wanted == STOPPED:
            paused = self._loop.ask(partial(self._loop.pause, True))
            done = self._loop.ask(self._loop.reset)
            if not paused.success:  # out of a fault a reset comes first
                self._loop.ask(partial(self._loop.pause, True))
            self._fill(response, done)
        elif wanted in (PLAYING, PAUSED):
            self._fill(response, self._loop.ask(partial(self._loop.pause, wanted == PAUSED)))
        else:
            response.result.result = UNSUPPORTED
            response.result.error_message = "end the process by SIGINT or SIGTERM"
        return response

    def reset(self, request: Any, response: Any) -> Any:
        """ResetSimulation; there is nothing spawned, and ROS time is never reset."""
        if request.scope in (0, SCOPE_ALL) or request.scope & SCOPE_STATE:
            self._fill(response, self._loop.ask(self._loop.reset))
        elif request.scope & SCOPE_SPAWNED:
            response.result.result = DONE
        else:
            response.result.result = UNSUPPORTED
            response.result.error_message = "ROS time continues; reset the state"
        return response

    def step(self, request: Any, response: Any) -> Any:
        """StepSimulation."""
        self._fill(response, self._loop.ask(partial(self._loop.step, int(request.steps))))
        return response

    def _state(self) -> int:
        if self._loop.phase is Phase.PAUSED and not self._loop.begun:
            return STOPPED
        return PLAYING if self._loop.phase in (Phase.WAITING, Phase.RUNNING) else PAUSED

    def _fill(self, response: Any, reply: Reply) -> None:
        response.result.result = DONE if reply.success else FAILED
        response.result.error_message = "" if reply.success else reply.message


def offer(node: Node, loop: RunLoop) -> bool:
    """Create the services if the package is installed; return whether it is."""
    if srv is None:
        return False
    answers = SimulationInterfaces(loop)
    table: dict[str, tuple[str, Callable[[Any, Any], Any]]] = {
        "get_simulator_features": ("GetSimulatorFeatures", answers.features),
        "get_simulation_state": ("GetSimulationState", answers.get_state),
        "set_simulation_state": ("SetSimulationState", answers.set_state),
        "reset_simulation": ("ResetSimulation", answers.reset),
        "step_simulation": ("StepSimulation", answers.step),
    }
    for name, (kind, answer) in table.items():
        qos = topics.SERVICE_QOS
        node.create_service(getattr(srv, kind), f"~/{name}", answer, qos_profile=qos)
    return True
