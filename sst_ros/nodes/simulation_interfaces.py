# SPDX-License-Identifier: Apache-2.0
"""The services and the action of simulation_interfaces 2.x, where that package is installed.

The same state machine as that of ~/pause, ~/step and ~/reset answers. STOPPED is a run at its
initial state that is paused. The numbers are those of the package's messages.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.action.server import ActionServer, CancelResponse
from rclpy.node import Node

from sst_ros.nodes import topics
from sst_ros.nodes.action_goal import ActionGoal
from sst_ros.nodes.simulated_star import OK, UNSUPPORTED, SimulatedStar, answer, replied
from sst_ros.runtime.run_loop import Phase, Reply, RunLoop

try:
    from simulation_interfaces import action, srv
except ImportError:  # not part of every installation, nor of the wheels
    action = srv = None

STOPPED, PLAYING, PAUSED, QUITTING = range(4)
ALREADY_THERE, INCORRECT_TRANSITION = 101, 103
SCOPE_TIME, SCOPE_STATE, SCOPE_SPAWNED, SCOPE_ALL = 1, 2, 4, 255
FEATURES = (10, 11, 20, 22, 24, 25, 26, 31, 32, 33)
"""Get and set the state of an entity, reset, reset of the state, get and set the state of the
simulation, pause, one step, many steps, many steps by an action."""
SERVICES = {
    "get_entities": "GetEntities",
    "get_entities_states": "GetEntitiesStates",
    "get_entity_state": "GetEntityState",
    "get_simulation_state": "GetSimulationState",
    "get_simulator_features": "GetSimulatorFeatures",
    "reset_simulation": "ResetSimulation",
    "set_entity_state": "SetEntityState",
    "set_simulation_state": "SetSimulationState",
    "spawn_entity": "SpawnEntity",
    "step_simulation": "StepSimulation",
}
"""Types of the services, by name; also the names of the methods that answer them."""
INFORMATION = (
    "sst_ros: the entity `star` has the state of the joints, which joint_states publishes and "
    "~/set_state takes; ROS time continues over a reset"
)


class SimulationInterfaces:
    """Answers the services; each takes a request and fills a response.

    Args:
        loop: the run.
        leave: ends the node.

    """

    def __init__(self, loop: RunLoop, leave: Callable[[], None]) -> None:
        self._loop, self._leave = loop, leave

    def get_simulator_features(self, _: Any, response: Any) -> Any:
        """List the features."""
        response.features.features = list(FEATURES)
        response.features.custom_info = INFORMATION
        return response

    def get_simulation_state(self, _: Any, response: Any) -> Any:
        """Return the state of the simulation."""
        response.state.state = self._state()
        return answer(response, OK)

    def set_simulation_state(self, request: Any, response: Any) -> Any:
        """Change the state of the simulation."""
        wanted = request.state.state
        if wanted == self._state():
            return answer(response, ALREADY_THERE)
        if wanted == PAUSED and self._state() == STOPPED:
            text = "a stopped simulation can be started, not paused"
            return answer(response, INCORRECT_TRANSITION, text)
        if wanted == STOPPED:
            paused = self._loop.ask(partial(self._loop.pause, True))
            done = self._loop.ask(self._loop.reset)
            if not paused.success:  # out of a fault a reset comes first
                self._loop.ask(partial(self._loop.pause, True))
            return replied(response, done)
        if wanted in (PLAYING, PAUSED):
            return replied(response, self._loop.ask(partial(self._loop.pause, wanted == PAUSED)))
        if wanted == QUITTING:
            self._leave()
            return answer(response, OK)
        return answer(response, UNSUPPORTED, "the scene is loaded at the start and stays")

    def reset_simulation(self, request: Any, response: Any) -> Any:
        """Reset; there is nothing spawned, and ROS time is never reset."""
        scope = request.scope or SCOPE_ALL
        if scope != SCOPE_ALL and scope & ~(SCOPE_STATE | SCOPE_SPAWNED):
            text = "ROS time continues; reset the state"
            return answer(response, UNSUPPORTED, text)
        if scope & SCOPE_STATE:
            return replied(response, self._loop.ask(self._loop.reset))
        return answer(response, OK)

    def step_simulation(self, request: Any, response: Any) -> Any:
        """Step a paused run by some samples."""
        return replied(response, self._loop.ask(partial(self._loop.step, int(request.steps))))

    def spawn_entity(self, request: Any, response: Any) -> Any:
        """Refuse, by the name of what was to be spawned."""
        text = f"{request.name or 'nothing'} is not spawned: the scene has one manipulator"
        return answer(response, UNSUPPORTED, text)

    def _state(self) -> int:
        if self._loop.phase is Phase.PAUSED and not self._loop.begun:
            return STOPPED
        return PLAYING if self._loop.phase in (Phase.WAITING, Phase.RUNNING) else PAUSED


class StepsAction:
    """The action ~/simulate_steps: steps of a paused run, with feedback after each.

    A thread asks for the steps, so that the node answers meanwhile.
    """

    def __init__(self, node: Node, loop: RunLoop) -> None:
        self._loop = loop
        self._server: Any = ActionServer(
            node,
            action.SimulateSteps,
            "~/simulate_steps",
            lambda _: action.SimulateSteps.Result(),
            handle_accepted_callback=self._begin,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _begin(self, handle: Any) -> None:
        threading.Thread(target=self._run, args=(ActionGoal(handle),), daemon=True).start()

    def _run(self, goal: ActionGoal) -> None:
        handle = goal.handle
        steps, reply = int(handle.request.steps), Reply(True, "")
        feedback = action.SimulateSteps.Feedback()
        for done in range(1, steps + 1):
            if handle.is_cancel_requested:
                break
            reply = self._loop.ask(self._loop.step)
            if not reply.success:
                break
            feedback.completed_steps, feedback.remaining_steps = done, steps - done
            handle.publish_feedback(feedback)
        goal.end(replied(action.SimulateSteps.Result(), reply), success=reply.success)


def offer(node: Node, loop: RunLoop, leave: Callable[[], None]) -> bool:
    """Create the services and the action if the package is installed; return whether it is."""
    if srv is None:
        return False
    answers, star = SimulationInterfaces(loop, leave), SimulatedStar(loop)
    for name, kind in SERVICES.items():
        handler = getattr(star if hasattr(star, name) else answers, name)
        qos = topics.SERVICE_QOS
        node.create_service(getattr(srv, kind), f"~/{name}", handler, qos_profile=qos)
    StepsAction(node, loop)
    return True
