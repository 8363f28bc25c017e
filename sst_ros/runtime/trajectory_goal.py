# SPDX-License-Identifier: Apache-2.0
"""A JointTrajectory as a desired motion, and a goal of FollowJointTrajectory: or why it is refused.

The rules of goals are those of ros2_controllers' joint_trajectory_controller: tolerances of the
path hold until the time of the last point, those of the goal from then on.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

from sst_ros.control.actuator_motions import through_points
from sst_ros.control.controller import Measurement
from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.generic_math import axpy
from sst_ros.mechanism.geometry import Geometry
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.state import NANOSECONDS, nanoseconds

NO_TOLERANCE = -1.0
"""Of a message: the default does not hold either."""

_QUANTITIES = (("position", "rad"), ("velocity", "rad/s"))


def motion_of(message: Any, geometry: Geometry, begin: Reference) -> ReferenceMotion:
    """Take over a trajectory_msgs/JointTrajectory; its joints may come in any order.

    It begins immediately and continues the reference, which may be moving.

    Args:
        message: the trajectory; positions are needed, velocities and accelerations may be left
            out.
        geometry: of the manipulator.
        begin: the reference now.

    Raises:
        InputError: lists every fault.
        SingularConfiguration: the path crosses a parallel singularity.

    """
    if problems := [*_trajectory_faults(message, begin)]:
        raise InputError("joint_trajectory", problems)
    places = [list(message.joint_names).index(name) for name in ACTUATORS]
    points = message.points
    return through_points(
        geometry,
        begin.quaternion,
        [nanoseconds(point.time_from_start) / NANOSECONDS for point in points],
        [_by_leg(point.positions, places) for point in points],
        [_by_leg(point.velocities, places) for point in points],
        [_by_leg(point.accelerations, places) for point in points],
        begin=(begin.gamma_dot, begin.gamma_ddot),
    )


def _trajectory_faults(message: Any, begin: Reference) -> Iterator[Problem]:
    names = list(message.joint_names)
    if sorted(names) != list(ACTUATORS):
        yield Problem("joint_names", names, f"must be {', '.join(ACTUATORS)}, each once")
    if stamp := nanoseconds(message.header.stamp):
        yield Problem("header.stamp", stamp, "must be zero: a trajectory begins immediately")
    for index, point in enumerate(message.points):
        if len(point.effort):
            allowed = "must be left out: it is computed"
            yield Problem(f"points[{index}].effort", list(point.effort), allowed)
    first = message.points[0] if any(begin.gamma_dot) and message.points else None
    if first is not None and not nanoseconds(first.time_from_start):
        allowed = "must be > 0 s while the reference is moving"
        yield Problem("points[0].time_from_start", 0.0, allowed)


def _by_leg(values: Sequence[float], places: Sequence[int]) -> list[float]:
    """Sort by leg what is whole; what is not is refused as it is."""
    return [float(values[k]) for k in places] if len(values) == len(places) else list(values)


class ErrorCode(IntEnum):
    """Codes of the action's result that are used."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Outcome(NamedTuple):
    """End of a goal."""

    code: ErrorCode
    message: str


Tolerances = dict[str, dict[str, float]]
"""Largest error by actuator and quantity [rad], [rad/s]; 0 where there is none."""


class TrajectoryGoal:
    """Tolerances of a goal, and its outcome.

    Args:
        message: the goal, a FollowJointTrajectory.Goal; its trajectory is checked elsewhere. A
            tolerance of 0 means the default, -1 that there is none. Tolerances of accelerations,
            which are not measured, have no effect.
        defaults: of the tolerances.

    Attributes:
        path, goal: tolerances until the end of the trajectory, and from then on.
        goal_time: time after the end until which those of the goal must be met [s]; 0 for no end.

    Raises:
        InputError: a tolerance is of another joint or not allowed, or the goal has joints of
            several degrees of freedom.

    """

    def __init__(self, message: Any, defaults: ControllerNodeParameters) -> None:
        problems = [*_multi_dof(message)]
        own = {"position": defaults.path_tolerance, "velocity": 0.0}
        self.path = _tolerances("path_tolerance", message.path_tolerance, own, problems)
        own = {
            "position": defaults.goal_tolerance,
            "velocity": defaults.stopped_velocity_tolerance,
        }
        self.goal = _tolerances("goal_tolerance", message.goal_tolerance, own, problems)
        time = nanoseconds(message.goal_time_tolerance) / NANOSECONDS
        self.goal_time = _resolve(
            "goal_time_tolerance", time, defaults.goal_time_tolerance, problems
        )
        if problems:
            raise InputError("follow_joint_trajectory", problems)
        points = message.trajectory.points
        self._times = [nanoseconds(point.time_from_start) / NANOSECONDS for point in points]

    def index(self, time: float) -> int:
        """Return the index of the point that is approached at a time of the motion [s]."""
        return min(bisect_right(self._times, time), len(self._times) - 1)

    def outcome(self, time: float, desired: Reference, measured: Measurement) -> Outcome | None:
        """Return the end of the goal at a sample; None as long as it goes on.

        Args:
            time: of the motion [s].
            desired: the reference there.
            measured: the actuators there.

        """
        errors = {
            "position": axpy(1.0, desired.gamma, -1.0, measured.gamma),
            "velocity": axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot),
        }
        late = time - self._times[-1]
        if late < 0.0:
            for violation in _violations("path tolerance", self.path, errors):
                return Outcome(ErrorCode.PATH_TOLERANCE_VIOLATED, violation)
            return None
        unmet = next(_violations("goal tolerance", self.goal, errors), None)
        if unmet is None:
            return Outcome(ErrorCode.SUCCESSFUL, "goal reached")
        if not 0.0 < self.goal_time < late:
            return None
        when = f"{late:.3f} s after the end, goal_time_tolerance {self.goal_time:g} s"
        return Outcome(ErrorCode.GOAL_TOLERANCE_VIOLATED, f"{unmet} {when}")


def _violations(
    kind: str, tolerances: Tolerances, errors: dict[str, tuple[float, float, float]]
) -> Iterator[str]:
    for quantity, unit in _QUANTITIES:
        for joint, error in zip(ACTUATORS, errors[quantity], strict=True):
            allowed = tolerances[joint][quantity]
            if allowed and not abs(error) <= allowed:
                yield f"{joint}: {quantity} error {error:.6g} {unit}, {kind} {allowed:g} {unit}"


def _tolerances(
    name: str, given: Iterable[Any], defaults: dict[str, float], problems: list[Problem]
) -> Tolerances:
    """Resolve a sequence of JointTolerance messages; what is wrong joins the problems."""
    found = {joint: dict(defaults) for joint in ACTUATORS}
    for index, tolerance in enumerate(given):
        place = f"{name}[{index}]"
        if tolerance.name not in found:
            allowed = f"must be one of {', '.join(ACTUATORS)}"
            problems.append(Problem(f"{place}.name", tolerance.name, allowed))
            continue
        for quantity, default in defaults.items():
            value = getattr(tolerance, quantity)
            resolved = _resolve(f"{place}.{quantity}", value, default, problems)
            found[tolerance.name][quantity] = resolved
    return found


def _resolve(name: str, value: float, default: float, problems: list[Problem]) -> float:
    if value == NO_TOLERANCE:
        return 0.0
    if not (math.isfinite(value) and value >= 0.0):
        allowed = "must be > 0, 0 for the default or -1 for none"
        problems.append(Problem(name, value, allowed))
    return value or default


def _multi_dof(message: Any) -> Iterator[Problem]:
    given = message.multi_dof_trajectory
    for name, rows in (
        ("multi_dof_trajectory.joint_names", given.joint_names),
        ("multi_dof_trajectory.points", given.points),
        ("component_path_tolerance", message.component_path_tolerance),
        ("component_goal_tolerance", message.component_goal_tolerance),
    ):
        if len(rows):
            yield Problem(name, f"{len(rows)} entries", "must be empty: joints have one freedom")
