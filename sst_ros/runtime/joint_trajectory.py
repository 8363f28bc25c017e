# SPDX-License-Identifier: Apache-2.0
"""A JointTrajectory as a desired motion, or every reason why it is refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.control.waypoints import waypoints
from sst_ros.description.headers import nanoseconds
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.geometry import Geometry
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.state import NANOSECONDS


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
    if problems := [*_faults(message), *_jump(message, begin)]:
        raise InputError("joint_trajectory", problems)
    places = [list(message.joint_names).index(name) for name in ACTUATORS]
    points = message.points
    return waypoints(
        geometry,
        begin.quaternion,
        [nanoseconds(point.time_from_start) / NANOSECONDS for point in points],
        [_sorted(point.positions, places) for point in points],
        [_sorted(point.velocities, places) for point in points],
        [_sorted(point.accelerations, places) for point in points],
        begin=(begin.gamma_dot, begin.gamma_ddot),
    )


def _faults(message: Any) -> Iterator[Problem]:
    names = list(message.joint_names)
    if sorted(names) != list(ACTUATORS):
        yield Problem("joint_names", names, f"must be {', '.join(ACTUATORS)}, each once")
    if stamp := nanoseconds(message.header.stamp):
        yield Problem("header.stamp", stamp, "must be zero: a trajectory begins immediately")
    for index, point in enumerate(message.points):
        if len(point.effort):
            allowed = "must be left out: it is computed"
            yield Problem(f"points[{index}].effort", list(point.effort), allowed)


def _jump(message: Any, begin: Reference) -> Iterator[Problem]:
    moving = any(begin.gamma_dot)
    if moving and message.points and not nanoseconds(message.points[0].time_from_start):
        allowed = "must be > 0 s while the reference is moving"
        yield Problem("points[0].time_from_start", 0.0, allowed)


def _sorted(values: Sequence[float], places: Sequence[int]) -> list[float]:
    """Sort by leg what is whole; what is not is refused as it is."""
    return [float(values[k]) for k in places] if len(values) == len(places) else list(values)
