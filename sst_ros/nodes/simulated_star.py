# SPDX-License-Identifier: Apache-2.0
"""The manipulator as the entity `star` of simulation_interfaces: its pose and twist.

The star turns about O, the origin of base_link. Its orientation and angular velocity determine the
angles and rates of all joints, so to set them is to set the state of the joints.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.errors import AssemblyError
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.frames import angle_between, quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import ZERO
from sst_ros.runtime.run_loop import Reply, RunLoop
from sst_ros.state import BASE_FRAME, Quaternion, Vector3

NAME = "star"
UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
"""Codes of Result."""
INVALID_POSE = 101

_UNIT = 1e-3
"""Largest deviation of a quaternion's length from 1; it is normalised."""
_SAME = 1e-6
"""Largest angle between an orientation and the assembly at its actuator angles [rad]."""


class SimulatedStar:
    """Answers the services of entities; each takes a request and fills a response."""

    def __init__(self, loop: RunLoop) -> None:
        self._loop = loop
        self._space = ActuatorSpaceMap(loop.simulation.geometry)

    def get_entities(self, request: Any, response: Any) -> Any:
        """List the star, where the filter matches its name."""
        filters = request.filters
        if len(filters.categories) or len(filters.tags.tags) or filters.bounds.type:
            return answer(response, UNSUPPORTED, "the one entity is filtered by its name only")
        try:
            found = re.search(filters.filter, NAME) is not None
        except re.error as error:
            return answer(response, FAILED, f"filter {filters.filter!r}: {error}")
        response.entities = [NAME] if found else []
        return answer(response, OK)

    def get_entities_states(self, request: Any, response: Any) -> Any:
        """List the star and its state."""
        self.get_entities(request, response)
        if response.entities:
            from simulation_interfaces.msg import EntityState

            response.states = [self._fill(EntityState())]
        return response

    def get_entity_state(self, request: Any, response: Any) -> Any:
        """Return pose and twist in base_link; the acceleration is left at zero."""
        if request.entity != NAME:
            return _unknown(request, response)
        self._fill(response.state)
        return answer(response, OK)

    def set_entity_state(self, request: Any, response: Any) -> Any:
        """Set the state of a run that waits or is paused; the acceleration is ignored."""
        if request.entity != NAME:
            return _unknown(request, response)
        frame, pose, twist = request.state.header.frame_id, request.state.pose, request.state.twist
        if frame not in ("", "world", BASE_FRAME):
            return answer(response, FAILED, f"frame_id {frame!r} must be {BASE_FRAME}")
        now = self._loop.simulation.state
        quaternion, rate = now.quaternion, _turned(now.quaternion, now.body_rate)
        if getattr(request, "set_pose", True):  # the flags are new in 2.1
            try:
                quaternion = _unit(_numbers(pose.orientation, "xyzw"))
                if any(_numbers(pose.position, "xyz")):
                    raise ValueError("position must be zero: the star turns about the origin")
            except ValueError as error:
                return answer(response, INVALID_POSE, str(error))
        if getattr(request, "set_twist", True):
            try:
                rate = _numbers(twist.angular, "xyz")
                if any(_numbers(twist.linear, "xyz")):
                    raise ValueError("linear velocity must be zero: the star turns about O")
            except ValueError as error:
                return answer(response, FAILED, str(error))
        try:
            gamma, gamma_dot = self._actuators(quaternion, rate)
        except (AssemblyError, ArithmeticError) as error:
            return answer(response, INVALID_POSE, str(error) or "the manipulator is singular there")
        return replied(response, self._loop.ask(partial(self._loop.set_state, gamma, gamma_dot)))

    def _actuators(self, quaternion: Quaternion, rate: Vector3) -> tuple[Vector3, Vector3]:
        """Angles [rad] and rates [rad/s] of an orientation and an angular velocity in base_link.

        Raises:
            AssemblyError: the manipulator has no or another assembly mode there.
            ArithmeticError: serial singularity.

        """
        matrix = rotation_matrix(quaternion)
        x, y, z = (matrix.T @ rate).tolist()
        at = self._space.of_star(quaternion, (x, y, z), ZERO)
        assembly = kinematics.admissible(self._space.geometry, at.gamma)
        if not angle_between(quaternion_of(assembly.rotation), quaternion) < _SAME:
            text = "the orientation belongs to another assembly mode"
            raise AssemblyError(text, np.array(at.gamma))
        return at.gamma, at.gamma_dot

    def _fill(self, message: Any) -> Any:
        state = self._loop.simulation.state
        message.header.frame_id = BASE_FRAME
        _write(message.pose.orientation, "xyzw", state.quaternion)
        _write(message.twist.angular, "xyz", _turned(state.quaternion, state.body_rate))
        return message


def answer(response: Any, code: int, text: str = "") -> Any:
    """Fill the result of a response, and return the response."""
    response.result.result, response.result.error_message = code, text
    return response


def replied(response: Any, reply: Reply) -> Any:
    """Fill the result of a response from a reply of the run, and return the response."""
    return answer(response, OK) if reply.success else answer(response, FAILED, reply.message)


def _unknown(request: Any, response: Any) -> Any:
    return answer(response, NOT_FOUND, f"there is no entity {request.entity!r}, only {NAME!r}")


def _turned(quaternion: Quaternion, vector: Vector3) -> Vector3:
    """From {E} into base_link."""
    x, y, z = (rotation_matrix(quaternion) @ vector).tolist()
    return x, y, z


def _numbers(message: Any, names: str) -> Any:
    numbers = tuple(getattr(message, name) for name in names)
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{type(message).__name__} must be finite numbers")
    return numbers


def _unit(quaternion: Quaternion) -> Quaternion:
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) < _UNIT:
        raise ValueError(f"orientation has length {length:.6g}, must be 1")
    x, y, z, w = (part / length for part in quaternion)
    return x, y, z, w


def _write(message: Any, names: str, values: Sequence[float]) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(message, name, value)
