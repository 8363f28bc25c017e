# SPDX-License-Identifier: Apache-2.0
"""Trajectories and goals as messages have them: points, a motion through them, tolerances.

The rules of goals are those of ros2_controllers' joint_trajectory_controller:
tolerances of the path hold until the time of the last point, those of the goal from
then on.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from enum import IntEnum
from operator import attrgetter
from typing import Any, NamedTuple

from sst_ros.control.actuator_space import Reference, ReferenceMotion
from sst_ros.control.plan import check_motion
from sst_ros.control.reference_motions import through_points
from sst_ros.errors import Check, refuse_unless
from sst_ros.mechanism.geometry import Geometry
from sst_ros.runtime.settings import ControllerNodeParameters
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, Vector3, nanoseconds

NO_TOLERANCE = -1.0  # in a message: the default does not hold either


class Points(NamedTuple):
    """Points of a trajectory_msgs/JointTrajectory: rows in the order of the legs."""

    stamp_ns: int  # when it begins; 0 for at once
    times: list[float]  # from then on [s]
    # positions, velocities, accelerations; empty where open
    rows: tuple[list[list[float]], ...]


def read_points(message: Any) -> Points:
    """Read a trajectory_msgs/JointTrajectory; its joints may come in any order.

    Positions are needed, velocities and accelerations may be left out. An InputError
    lists faults; `plan` finds those of the numbers.
    """
    names, stamp_ns = list(message.joint_names), nanoseconds(message.header.stamp)
    one_each = f"must be {', '.join(ACTUATORS)}, each once"
    refuse_unless(
        "joint_trajectory",
        ("joint_names", names, sorted(names) == list(ACTUATORS), one_each),
        *(
            (
                f"points[{i}].effort",
                [*at.effort],
                not at.effort,
                "must be left out: it is computed",
            )
            for i, at in enumerate(message.points)
        ),
    )
    places = [names.index(name) for name in ACTUATORS]

    def by_leg(quantity: str) -> list[list[float]]:
        """Sort by leg what is whole; what is not is refused as it is."""
        rows = [list(map(float, getattr(point, quantity))) for point in message.points]
        return [
            [row[k] for k in places] if len(row) == len(places) else row for row in rows
        ]

    times = [
        nanoseconds(point.time_from_start) / NANOSECONDS for point in message.points
    ]
    return Points(
        stamp_ns,
        times,
        tuple(map(by_leg, ("positions", "velocities", "accelerations"))),
    )


def plan(
    model: Scene, points: Points, begin: Reference, passed: float
) -> ReferenceMotion:
    """Return the motion from a reference, which may be moving, through points.

    It is checked.

    `passed` is the time of the trajectory at which it begins [s]. Points that lie
    before, and one at time 0 where the reference moves, are passed already. An
    InputError lists every fault; MotionRefused and SingularConfiguration say why the
    motion cannot be followed.
    """
    times, rows = points.times, list(points.rows)
    if passed > 0.0 or any((*begin.gamma_dot, *begin.gamma_ddot)):
        ahead = [index for index, time in enumerate(times) if time > passed]
        late = (
            f"must lie less than {max(times, default=0.0):g} s back: all points have"
            " passed"
        )
        refuse_unless(
            "joint_trajectory", ("header.stamp", points.stamp_ns, bool(ahead), late)
        )
        times = [times[index] - passed for index in ahead]
        rows = [[row[index] for index in ahead] for row in rows]
    geometry, going = Geometry.of(model), (begin.gamma_dot, begin.gamma_ddot)
    motion = through_points(
        geometry, begin.quaternion, times, rows[0], rows[1], rows[2], going
    )
    check_motion(motion, model)
    return motion


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
        names = (
            "multi_dof_trajectory.joint_names",
            "multi_dof_trajectory.points",
            "component_path_tolerance",
            "component_goal_tolerance",
        )
        rows, allowed = (
            attrgetter(*names)(message),
            "must be empty: joints have one freedom",
        )
        self._checks: list[Check] = [
            (name, f"{len(x)} entries", not x, allowed)
            for name, x in zip(names, rows, strict=True)
        ]
        self._path = self._resolve_all(
            message, "path_tolerance", defaults.path_tolerance, 0.0
        )
        still = defaults.stopped_velocity_tolerance
        self._goal = self._resolve_all(
            message, "goal_tolerance", defaults.goal_tolerance, still
        )
        name = "goal_time_tolerance"
        late = nanoseconds(message.goal_time_tolerance) / NANOSECONDS
        self._late = self._resolve(name, late, defaults.goal_time_tolerance)
        refuse_unless("follow_joint_trajectory", *self._checks)
        points = message.trajectory.points
        self._times = [
            nanoseconds(point.time_from_start) / NANOSECONDS for point in points
        ]

    def _resolve_all(
        self, message: Any, name: str, position: float, velocity: float
    ) -> dict[tuple[str, str], float]:
        """Largest error by quantity and actuator [rad], [rad/s].

        0 where there is none.
        """
        own = {"position": position, "velocity": velocity}
        found = {
            (quantity, joint): own[quantity] for quantity in own for joint in ACTUATORS
        }
        for index, tolerance in enumerate(getattr(message, name)):
            place = f"{name}[{index}]"
            known, allowed = (
                tolerance.name in ACTUATORS,
                f"must be one of {', '.join(ACTUATORS)}",
            )
            self._checks.append((f"{place}.name", tolerance.name, known, allowed))
            for quantity, default in own.items():
                value = getattr(tolerance, quantity)
                resolved = self._resolve(f"{place}.{quantity}", value, default)
                found[quantity, tolerance.name] = resolved
        return found

    def _resolve(self, name: str, value: float, default: float) -> float:
        none, allowed = (
            value == NO_TOLERANCE,
            "must be > 0, 0 for the default or -1 for none",
        )
        self._checks.append((name, value, none or 0.0 <= value < math.inf, allowed))
        return 0.0 if none else value or default

    def index(self, time: float) -> int:
        """Return the index of the point that is approached at a time of the motion [s]."""
        return min(bisect_right(self._times, time), len(self._times) - 1)

    def outcome(
        self, time: float, error: Vector3, error_rate: Vector3
    ) -> tuple[ErrorCode, str] | None:
        """Return how the goal ends at a sample, and why; None as long as it goes on.

        The time is that of the motion [s], the errors are desired - measured [rad],
        [rad/s].
        """
        late = time - self._times[-1]
        kind, tolerances = ("path", self._path) if late < 0.0 else ("goal", self._goal)
        errors, unmet = (*error, *error_rate), ""
        for ((quantity, joint), allowed), off in zip(
            tolerances.items(), errors, strict=True
        ):
            if allowed and not abs(off) <= allowed:
                unit = "rad" if quantity == "position" else "rad/s"
                words = f"{kind} tolerance {allowed:g} {unit}"
                unmet = f"{joint}: {quantity} error {off:.6g} {unit}, {words}"
                break
        if late < 0.0:
            return (ErrorCode.PATH_TOLERANCE_VIOLATED, unmet) if unmet else None
        if not unmet:
            return ErrorCode.SUCCESSFUL, "goal reached"
        if not 0.0 < self._late < late:
            return None
        when = f"{late:.3f} s after the end, goal_time_tolerance {self._late:g} s"
        return ErrorCode.GOAL_TOLERANCE_VIOLATED, f"{unmet} {when}"
