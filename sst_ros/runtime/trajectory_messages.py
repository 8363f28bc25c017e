# SPDX-License-Identifier: Apache-2.0
"""Trajectories and goals of messages: points, a motion through them, tolerances.

The rules of goals are those of ros2_controllers' joint_trajectory_controller:
tolerances of the path hold until the time of the last point, those of the goal from
then on.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from enum import IntEnum
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import Reference, ReferenceMotion
from sst_ros.control.plan import check_motion
from sst_ros.control.reference_motions import through_points
from sst_ros.errors import Check, refuse_unless
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.scene.loads import ACTUATED_JOINTS
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, ZERO, Vector3, nanoseconds

NO_TOLERANCE = -1.0  # in a message: the default does not hold either


class Points(NamedTuple):
    """Points of a trajectory_msgs/JointTrajectory: rows by leg, empty where open."""

    stamp_ns: int  # when it begins; 0 for at once
    times: list[float]  # from then on [s]
    legs: list[int]  # of the actuators that it moves; the others hold their position
    positions: list[list[float]]
    velocities: list[list[float]]
    accelerations: list[list[float]]
    efforts: list[list[float]]  # no rows where no torques are added


def read_points(message: Any, *, is_partial_allowed: bool = False) -> Points:
    """Read a trajectory_msgs/JointTrajectory; its joints may come in any order.

    Positions are needed; velocities and accelerations may be left out, efforts in all
    points or in none. Some joints suffice where that is allowed. An InputError lists
    faults; `plan` finds those of the numbers.
    """
    names = list(message.joint_names)
    is_known = sorted(names) == list(ACTUATED_JOINTS)
    requirement = f"must be {', '.join(ACTUATED_JOINTS)}, each once"
    if is_partial_allowed:
        is_known = 0 < len(names) == len({*names} & {*ACTUATED_JOINTS})
        requirement = f"must be some of {', '.join(ACTUATED_JOINTS)}, each once"
    elif set(names) < set(ACTUATED_JOINTS):
        requirement += ", or allow_partial_joints_goal true"
    refuse_unless("joint_trajectory", ("joint_names", names, is_known, requirement))
    legs = [leg for leg, name in enumerate(ACTUATED_JOINTS) if name in names]
    places = [names.index(ACTUATED_JOINTS[leg]) for leg in legs]
    row_requirement = (
        f"must be {len(names)} finite numbers, one for each of joint_names"
    )
    checks: list[Check] = []

    def rows_of(quantity: str) -> list[list[float]]:
        """Return the rows of a quantity by leg; those of another length are refused."""
        rows = []
        for index, point in enumerate(message.points):
            row = [float(number) for number in getattr(point, quantity)]
            fits = len(row) in (0, len(names))
            checks.append((f"points[{index}].{quantity}", row, fits, row_requirement))
            rows.append([row[place] for place in places] if row and fits else row)
        return rows

    positions = rows_of("positions")
    velocities = rows_of("velocities")
    accelerations = rows_of("accelerations")
    efforts = rows_of("effort")
    if any(efforts):
        for index, row in enumerate(efforts):
            fits = len(row) > 0 and all(map(math.isfinite, row))
            effort_requirement = f"{row_requirement}, or none in any point"
            checks.append((f"points[{index}].effort", row, fits, effort_requirement))
    else:
        efforts = []
    refuse_unless("joint_trajectory", *checks)
    times = [
        nanoseconds(point.time_from_start) / NANOSECONDS for point in message.points
    ]
    stamp_ns = nanoseconds(message.header.stamp)
    return Points(stamp_ns, times, legs, positions, velocities, accelerations, efforts)


def plan(
    model: Scene,
    points: Points,
    begin: Reference,
    passed: float,
    effort: Vector3 = ZERO,
) -> ReferenceMotion:
    """Return the motion from a reference, which may be moving, through points.

    Points that lie before, and one at time 0 where the reference moves, are passed
    already. The motion is checked. Efforts are interpolated linearly, without any in
    the points to zero at the first one; they are no part of the check, as commands are
    limited.

    Args:
        model: the scene of the controller.
        points: those of the message.
        begin: the reference from which the motion goes on.
        passed: time of the trajectory at which it begins [s].
        effort: torques that are added then [N m].

    Raises:
        InputError: lists every fault of the points.
        MotionRefused, SingularConfiguration: the motion cannot be followed.

    """
    if passed > 0.0 or any((*begin.gamma_dot, *begin.gamma_ddot)):
        points = _points_ahead(points, passed)
    geometry = Geometry.of(model)
    motion = through_points(
        geometry,
        begin.quaternion,
        points.times,
        [_fill_in(row, points.legs, begin.gamma) for row in points.positions],
        [_fill_in(row, points.legs, ZERO) for row in points.velocities],
        [_fill_in(row, points.legs, ZERO) for row in points.accelerations],
        (begin.gamma_dot, begin.gamma_ddot),
    )
    check_motion(motion, model)
    if not points.efforts and not any(effort):
        return motion
    times = points.times
    efforts = [_fill_in(row, points.legs, ZERO) for row in points.efforts]
    if not efforts:  # what is added until now ends without a step
        efforts = [list(ZERO) for _ in times]
    if times[0] > 0.0:
        times = [0.0, *times]
        efforts = [list(effort), *efforts]
    motion.effort = partial(_interpolate, np.array(times), np.array(efforts))
    return motion


def _points_ahead(points: Points, passed: float) -> Points:
    """Return the points after a time of the trajectory [s], with times from there."""
    ahead = [index for index, time in enumerate(points.times) if time > passed]
    latest = max(points.times, default=0.0)
    late = f"must lie less than {latest:g} s back: all points have passed"
    refuse_unless(
        "joint_trajectory", ("header.stamp", points.stamp_ns, bool(ahead), late)
    )
    return points._replace(
        times=[points.times[index] - passed for index in ahead],
        positions=[points.positions[index] for index in ahead],
        velocities=[points.velocities[index] for index in ahead],
        accelerations=[points.accelerations[index] for index in ahead],
        efforts=[points.efforts[index] for index in ahead] if points.efforts else [],
    )


def _fill_in(row: list[float], legs: list[int], defaults: Vector3) -> list[float]:
    """Return a row of all legs, with the numbers of those that are not in it.

    Open if empty.
    """
    if not row:
        return row
    all_legs = list(defaults)
    for leg, number in zip(legs, row, strict=True):
        all_legs[leg] = number
    return all_legs


def _interpolate(times: Array, rows: Array, time: float) -> Vector3:
    """Return the row at a time on straight lines; a function that pickle takes."""
    return triple(float(np.interp(time, times, column)) for column in rows.T)


class ErrorCode(IntEnum):
    """Codes of the action's result that are used."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class TrajectoryGoal:
    """Tolerances of a goal, a FollowJointTrajectory.Goal, and its outcome.

    A tolerance of 0 means the default, -1 that there is none. Tolerances of
    accelerations, which are not measured, have no effect. An InputError lists
    tolerances of other joints or values that are not allowed, and joints of several
    degrees of freedom; the trajectory is checked elsewhere.
    """

    def __init__(self, message: Any, defaults: ControllerNodeParameters) -> None:
        self._checks: list[Check] = []
        for name in (
            "multi_dof_trajectory.joint_names",
            "multi_dof_trajectory.points",
            "component_path_tolerance",
            "component_goal_tolerance",
        ):
            entries = attrgetter(name)(message)
            requirement = "must be empty: joints have one freedom"
            count = f"{len(entries)} entries"
            self._checks.append((name, count, not entries, requirement))
        self._path = self._resolve_all(
            message, "path_tolerance", defaults.path_tolerance, 0.0
        )
        self._goal = self._resolve_all(
            message,
            "goal_tolerance",
            defaults.goal_tolerance,
            defaults.stopped_velocity_tolerance,
        )
        self._late = self._resolve(
            "goal_time_tolerance",
            nanoseconds(message.goal_time_tolerance) / NANOSECONDS,
            defaults.goal_time_tolerance,
        )
        refuse_unless("follow_joint_trajectory", *self._checks)
        points = message.trajectory.points
        self._times = [
            nanoseconds(point.time_from_start) / NANOSECONDS for point in points
        ]

    def _resolve_all(
        self, message: Any, name: str, position: float, velocity: float
    ) -> dict[tuple[str, str], float]:
        """Return the largest error by quantity and actuator [rad], [rad/s].

        It is 0 where there is none. The defaults are those of a position and of a
        velocity.
        """
        defaults = {"position": position, "velocity": velocity}
        tolerances: dict[tuple[str, str], float] = {}
        for quantity, default in defaults.items():
            for joint in ACTUATED_JOINTS:
                tolerances[quantity, joint] = default
        for index, tolerance in enumerate(getattr(message, name)):
            place = f"{name}[{index}]"
            is_joint = tolerance.name in ACTUATED_JOINTS
            requirement = f"must be one of {', '.join(ACTUATED_JOINTS)}"
            self._checks.append(
                (f"{place}.name", tolerance.name, is_joint, requirement)
            )
            for quantity, default in defaults.items():
                value = getattr(tolerance, quantity)
                resolved = self._resolve(f"{place}.{quantity}", value, default)
                tolerances[quantity, tolerance.name] = resolved
        return tolerances

    def _resolve(self, name: str, value: float, default: float) -> float:
        """Return a tolerance, its default where the message has 0, and 0 for none."""
        is_none = value == NO_TOLERANCE
        is_allowed = is_none or 0.0 <= value < math.inf
        requirement = "must be > 0, 0 for the default or -1 for none"
        self._checks.append((name, value, is_allowed, requirement))
        if is_none:
            return 0.0
        return value or default

    def index(self, time: float) -> int:
        """Return the index of the point approached at a time of the motion [s]."""
        return min(bisect_right(self._times, time), len(self._times) - 1)

    def outcome(
        self, time: float, error: Vector3, error_rate: Vector3
    ) -> tuple[ErrorCode, str] | None:
        """Return how the goal ends at a sample, and why; None as long as it goes on.

        The time is that of the motion [s], the errors are desired - measured [rad],
        [rad/s].
        """
        errors = (*error, *error_rate)
        late = time - self._times[-1]
        if late < 0.0:
            unmet = _find_unmet("path", self._path, errors)
            return (ErrorCode.PATH_TOLERANCE_VIOLATED, unmet) if unmet else None
        unmet = _find_unmet("goal", self._goal, errors)
        if not unmet:
            return ErrorCode.SUCCESSFUL, "goal reached"
        if not 0.0 < self._late < late:
            return None
        when = f"{late:.3f} s after the end, goal_time_tolerance {self._late:g} s"
        return ErrorCode.GOAL_TOLERANCE_VIOLATED, f"{unmet} {when}"


def _find_unmet(
    stretch: str, tolerances: dict[tuple[str, str], float], errors: Sequence[float]
) -> str:
    """Describe the first error beyond its tolerance, "" for none.

    Errors are in the order of the tolerances; a tolerance of 0 is none.
    """
    rows = zip(tolerances.items(), errors, strict=True)
    for ((quantity, joint), tolerance), error in rows:
        if tolerance and not abs(error) <= tolerance:
            unit = "rad" if quantity == "position" else "rad/s"
            violated = f"{stretch} tolerance {tolerance:g} {unit}"
            return f"{joint}: {quantity} error {error:.6g} {unit}, {violated}"
    return ""
