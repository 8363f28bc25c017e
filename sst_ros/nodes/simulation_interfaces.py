# SPDX-License-Identifier: Apache-2.0
"""Services and action of simulation_interfaces 2.x, where that is installed.

The same state machine as that of ~/pause, ~/step and ~/reset answers. STOPPED is a run
at its initial state that is paused. The numbers are those of the package's messages.

The entity `star` is the manipulator. It turns about O, the origin of base_link. Its
orientation and angular velocity determine the angles and rates of all joints, so to set
them is to set the state of the joints.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.errors import AssemblyError
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.geometry import angle_between, quaternion_of, rotation_matrix
from sst_ros.nodes import topics
from sst_ros.runtime.run_loop import Phase, Reply, RunLoop
from sst_ros.state import NANOSECONDS, ZERO, Quaternion, Vector3

ENTITY_NAME = "star"
UNSUPPORTED, RESULT_OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
"""Codes of Result."""
INVALID_POSE = 101

_LENGTH_DEVIATION = 1e-3
"""Largest deviation of a quaternion's length from 1; it is normalised."""
_SAME_ASSEMBLY = 1e-6
"""Largest angle between an orientation and the assembly at its actuator angles [rad].

Rounding is far below, and other assemblies are far above.
"""
STOPPED, PLAYING, PAUSED, QUITTING = range(4)
"""States of a simulation."""
ALREADY_THERE = 101
INCORRECT_TRANSITION = 103
"""Codes of Result for a change of the state."""
SCOPE_STATE = 2
SCOPE_SPAWNED = 4
SCOPE_ALL = 255
"""What is reset, as bits."""
FEATURES = (10, 11, 20, 22, 24, 25, 26, 31, 32, 33)
"""Get and set the state of an entity, reset, reset of the state, get and set the state
of the simulation, pause, one step, many steps, many steps by an action.
"""
SERVICES = (
    *("get_entities", "get_entities_states", "get_entity_state", "set_entity_state"),
    *("get_simulation_state", "set_simulation_state", "get_simulator_features"),
    *("reset_simulation", "step_simulation", "spawn_entity"),
)
"""Names of the services, and of the methods that answer them."""
_SERVICE_KINDS = {name: name.title().replace("_", "") for name in SERVICES}
_INTERFACE_TYPES = (
    *(f"simulation_interfaces/srv/{kind}" for kind in _SERVICE_KINDS.values()),
    "simulation_interfaces/action/SimulateSteps",
    "simulation_interfaces/msg/EntityState",
)
INFORMATION = (
    "sst_ros: the entity `star` has the state of the joints, which joint_states"
    " publishes and ~/set_state takes; ROS time continues over a reset"
)


def offer(
    node: Node, loop: RunLoop, leave: Callable[[], None], base_frame: str
) -> None:
    """Create the services and the action if the package is installed.

    `leave` ends the node.
    """
    types = topics.optional_types(node, _INTERFACE_TYPES)
    if types is None:
        return
    answers = SimulationInterfaces(loop, leave, base_frame, types)
    qos = topics.SERVICE_QOS
    for name, type_name in _SERVICE_KINDS.items():
        node.create_service(
            types[type_name], f"~/{name}", getattr(answers, name), qos_profile=qos
        )
    topics.ActionGoal.serve(
        node, types["SimulateSteps"], "~/simulate_steps", answers.begin_steps
    )


class SimulationInterfaces:
    """Answers the services; each takes a request and fills a response."""

    def __init__(
        self,
        loop: RunLoop,
        leave: Callable[[], None],
        base_frame: str,
        types: dict[str, Any],
    ) -> None:
        self._loop = loop
        self._leave = leave
        self._base_frame = base_frame
        self._types = types  # of messages, by their names
        self._space = ActuatorSpaceMap(loop.simulation.geometry)

    def get_simulator_features(self, _: Any, response: Any) -> Any:
        """List the features."""
        response.features.features = list(FEATURES)
        response.features.custom_info = INFORMATION
        return response

    def get_simulation_state(self, _: Any, response: Any) -> Any:
        """Return the state of the simulation.

        There is none for a fault, which is a failure.
        """
        response.state.state = self._state()
        if self._loop.phase is Phase.FAULT:
            return answer(response, FAILED, f"fault: {self._loop.fault}")
        return answer(response, RESULT_OK)

    def set_simulation_state(self, request: Any, response: Any) -> Any:
        """Change the state of the simulation.

        Out of a fault it can be stopped, or quit.
        """
        requested = request.state.state
        if self._loop.phase is Phase.FAULT and requested in (PLAYING, PAUSED):
            text = f"fault, reset or stop first: {self._loop.fault}"
            return answer(response, INCORRECT_TRANSITION, text)
        if requested == self._state():
            return answer(response, ALREADY_THERE)
        if requested == PAUSED and self._state() == STOPPED:
            text = "a stopped simulation can be started, not paused"
            return answer(response, INCORRECT_TRANSITION, text)
        if requested == STOPPED:
            return self._ask(response, self._loop.halt)
        if requested in (PLAYING, PAUSED):
            pause = partial(self._loop.pause, requested != PLAYING)
            return self._ask(response, pause)
        if requested == QUITTING:
            self._leave()
            return answer(response, RESULT_OK)
        return answer(
            response, UNSUPPORTED, "the scene is loaded at the start and stays"
        )

    def reset_simulation(self, request: Any, response: Any) -> Any:
        """Reset; there is nothing spawned, and ROS time is never reset."""
        scope = request.scope or SCOPE_ALL
        if scope != SCOPE_ALL and scope & ~(SCOPE_STATE | SCOPE_SPAWNED):
            return answer(response, UNSUPPORTED, "ROS time continues; reset the state")
        if scope & SCOPE_STATE:
            return self._ask(response, self._loop.reset)
        return answer(response, RESULT_OK)

    def step_simulation(self, request: Any, response: Any) -> Any:
        """Step a paused run by some samples."""
        return self._ask(response, partial(self._loop.step, int(request.steps)))

    def spawn_entity(self, request: Any, response: Any) -> Any:
        """Refuse, by the name of what was to be spawned."""
        text = (
            f"{request.name or 'nothing'} is not spawned: the scene has one manipulator"
        )
        return answer(response, UNSUPPORTED, text)

    def get_entities(self, request: Any, response: Any) -> Any:
        """List the star, where the filter matches its name."""
        filters = request.filters
        if len(filters.categories) or len(filters.tags.tags) or filters.bounds.type:
            return answer(
                response, UNSUPPORTED, "the one entity is filtered by its name only"
            )
        try:
            is_listed = re.search(filters.filter, ENTITY_NAME) is not None
        except re.error as error:
            return answer(response, FAILED, f"filter {filters.filter!r}: {error}")
        response.entities = [ENTITY_NAME] if is_listed else []
        return answer(response, RESULT_OK)

    def get_entities_states(self, request: Any, response: Any) -> Any:
        """List the star and its state."""
        self.get_entities(request, response)
        if response.entities:
            response.states = [self._fill(self._types["EntityState"]())]
        return response

    def get_entity_state(self, request: Any, response: Any) -> Any:
        """Return pose and twist in base_link; the acceleration is left at zero."""
        if unknown := _refuse_other(request, response):
            return unknown
        self._fill(response.state)
        return answer(response, RESULT_OK)

    def set_entity_state(self, request: Any, response: Any) -> Any:
        """Set the state of a run that waits or is paused.

        The acceleration is ignored.
        """
        if unknown := _refuse_other(request, response):
            return unknown
        frame = request.state.header.frame_id
        if frame not in ("", "world", self._base_frame):
            return answer(
                response, FAILED, f"frame_id {frame!r} must be {self._base_frame}"
            )
        state = self._loop.simulation.state
        quaternion = state.quaternion
        rate = _turn(state.quaternion, state.body_rate)
        refusal = INVALID_POSE
        try:
            if getattr(request, "set_pose", True):  # the flags are new in 2.1
                quaternion = _read_orientation(request.state.pose)
            if getattr(request, "set_twist", True):
                refusal = FAILED
                rate = _read_angular_velocity(request.state.twist)
            refusal = INVALID_POSE
            joints = self._actuators(quaternion, rate)
        except (ValueError, AssemblyError, ArithmeticError) as error:
            return answer(
                response, refusal, str(error) or "the manipulator is singular there"
            )
        return self._ask(response, partial(self._loop.set_state, *joints))

    def begin_steps(self, handle: Any) -> None:
        """Begin a goal of ~/simulate_steps: steps of a paused run, each with feedback.

        A thread asks for the steps, so that the node answers meanwhile.
        """
        action_type = self._types["SimulateSteps"]

        def run() -> None:
            steps = int(handle.request.steps)
            reply = Reply(True, "")
            for steps_done in range(1, steps + 1):
                if handle.is_cancel_requested:
                    break
                reply = self._loop.ask(self._loop.step)
                if not reply.success:
                    break
                left = steps - steps_done
                feedback = action_type.Feedback(
                    completed_steps=steps_done, remaining_steps=left
                )
                handle.publish_feedback(feedback)
            goal.end(answer_with(action_type.Result(), reply), success=reply.success)

        goal = topics.ActionGoal(handle)
        threading.Thread(target=run, daemon=True).start()

    def _actuators(
        self, quaternion: Quaternion, rate: Vector3
    ) -> tuple[Vector3, Vector3]:
        """Return angles [rad] and rates [rad/s] of the actuators.

        They are those of an orientation and an angular velocity in base_link. At a
        serial singularity an ArithmeticError is raised.
        """
        x, y, z = (rotation_matrix(quaternion).T @ rate).tolist()
        reference = self._space.of_star(quaternion, (x, y, z), ZERO)
        assembly = kinematics.admissible(self._space.geometry, reference.gamma)
        if (
            not angle_between(quaternion_of(assembly.rotation), quaternion)
            < _SAME_ASSEMBLY
        ):
            text = "the orientation belongs to another assembly mode"
            raise AssemblyError(text, np.array(reference.gamma))
        return reference.gamma, reference.gamma_dot

    def _fill(self, message: Any) -> Any:
        state = self._loop.simulation.state
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(self._loop.stamp_ns(state), NANOSECONDS)
        message.header.frame_id = self._base_frame
        orientation = message.pose.orientation
        turning = message.twist.angular
        orientation.x, orientation.y, orientation.z, orientation.w = state.quaternion
        turning.x, turning.y, turning.z = _turn(state.quaternion, state.body_rate)
        return message

    def _ask(self, response: Any, request: Callable[[], Reply]) -> Any:
        return answer_with(response, self._loop.ask(request))

    def _state(self) -> int:
        """Return the state of the simulation; a fault counts as paused."""
        phase = self._loop.phase
        if phase is Phase.PAUSED and not self._loop.begun:
            return STOPPED
        if phase in (Phase.WAITING, Phase.RUNNING):
            return PLAYING
        return PAUSED


def answer(response: Any, code: int, text: str = "") -> Any:
    """Fill the result of a response, and return the response."""
    response.result.result = code
    response.result.error_message = text
    return response


def answer_with(response: Any, reply: Reply) -> Any:
    """Fill the result of a response from a reply of the run, and return it."""
    if reply.success:
        return answer(response, RESULT_OK)
    return answer(response, FAILED, reply.message)


def _refuse_other(request: Any, response: Any) -> Any:
    """Return the filled response for another entity than the star, else None."""
    if request.entity == ENTITY_NAME:
        return None
    text = f"there is no entity {request.entity!r}, only {ENTITY_NAME!r}"
    return answer(response, NOT_FOUND, text)


def _read_orientation(pose: Any) -> Quaternion:
    """Return the orientation of a pose; raise ValueError where it cannot be set."""
    x, y, z, w = _numbers(pose.orientation, "xyzw")
    length = float(np.linalg.norm((x, y, z, w)))
    if not abs(length - 1.0) < _LENGTH_DEVIATION:
        raise ValueError(f"orientation has length {length:.6g}, must be 1")
    if any(_numbers(pose.position, "xyz")):
        raise ValueError("position must be zero: the star turns about the origin")
    return x / length, y / length, z / length, w / length


def _read_angular_velocity(twist: Any) -> Vector3:
    """Return that of a twist [rad/s]; raise ValueError where it cannot be set."""
    x, y, z = _numbers(twist.angular, "xyz")
    if any(_numbers(twist.linear, "xyz")):
        raise ValueError("linear velocity must be zero: the star turns about O")
    return x, y, z


def _turn(quaternion: Quaternion, vector: Vector3) -> Vector3:
    """Return a vector of {E} in base_link."""
    x, y, z = (rotation_matrix(quaternion) @ vector).tolist()
    return x, y, z


def _numbers(message: Any, names: str) -> tuple[float, ...]:
    """Return fields of a message; raise ValueError where one is not finite."""
    numbers = tuple(getattr(message, name) for name in names)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{type(message).__name__} must be finite numbers")
    return numbers
