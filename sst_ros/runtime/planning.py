# SPDX-License-Identifier: Apache-2.0
"""Trajectories of messages: their points, planned from a reference, and the outcome.

A JointTrajectory becomes a motion, or is refused with the reason.
"""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any, NamedTuple

from sst_ros.control.actuator_space import Reference, ReferenceMotion
from sst_ros.control.controller import Measurement
from sst_ros.control.plan import check_motion
from sst_ros.control.reference_motions import through_points
from sst_ros.errors import SstError, refuse_unless
from sst_ros.mechanism.geometry import Geometry
from sst_ros.runtime.torque_input import ACTUATORS
from sst_ros.scene.scene import Scene
from sst_ros.state import NANOSECONDS, nanoseconds


class Points(NamedTuple):
    """Points of a trajectory_msgs/JointTrajectory: rows in the order of the legs."""

    stamp_ns: int  # when it begins; 0 for at once
    times: list[float]  # from then on [s]
    rows: tuple[list[list[float]], ...]  # positions, velocities, accelerations; empty where open


def read_points(message: Any) -> Points:
    """Read a trajectory_msgs/JointTrajectory; its joints may come in any order.

    Positions are needed, velocities and accelerations may be left out. An InputError lists faults;
    `plan` finds those of the numbers.
    """
    names, stamp_ns = list(message.joint_names), nanoseconds(message.header.stamp)
    one_each = f"must be {', '.join(ACTUATORS)}, each once"
    refuse_unless(
        "joint_trajectory",
        ("joint_names", names, sorted(names) == list(ACTUATORS), one_each),
        *(
            (f"points[{i}].effort", [*at.effort], not at.effort, "must be left out: it is computed")
            for i, at in enumerate(message.points)
        ),
    )
    places = [names.index(name) for name in ACTUATORS]

    def by_leg(quantity: str) -> list[list[float]]:
        """Sort by leg what is whole; what is not is refused as it is."""
        rows = [list(map(float, getattr(point, quantity))) for point in message.points]
        return [[row[k] for k in places] if len(row) == len(places) else row for row in rows]

    times = [nanoseconds(point.time_from_start) / NANOSECONDS for point in message.points]
    return Points(stamp_ns, times, tuple(map(by_leg, ("positions", "velocities", "accelerations"))))


def plan(model: Scene, points: Points, begin: Reference, passed: float) -> ReferenceMotion:
    """Return the motion from a reference, which may be moving, through points; it is checked.

    `passed` is the time of the trajectory at which it begins [s]. Points that lie before, and one
    at time 0 where the reference moves, are passed already. An InputError lists every fault;
    MotionRefused and SingularConfiguration say why the motion cannot be followed.
    """
    times, rows = points.times, list(points.rows)
    if passed > 0.0 or any((*begin.gamma_dot, *begin.gamma_ddot)):
        ahead = [index for index, time in enumerate(times) if time > passed]
        late = f"must lie less than {max(times, default=0.0):g} s back: all points have passed"
        refuse_unless("joint_trajectory", ("header.stamp", points.stamp_ns, bool(ahead), late))
        times = [times[index] - passed for index in ahead]
        rows = [[row[index] for index in ahead] for row in rows]
    geometry, going = Geometry.of(model), (begin.gamma_dot, begin.gamma_ddot)
    motion = through_points(geometry, begin.quaternion, times, rows[0], rows[1], rows[2], going)
    check_motion(motion, model)
    return motion


class Order:
    """A trajectory between its message and its motion.

    Attributes:
        outcome: a result where the trajectory is accepted, else the SstError that says why not;
            cancelled where a newer one came before this was checked.
        passed: time of the trajectory at which its motion begins [s].

    """

    def __init__(self, points: Points, seen: Measurement | None, seen_ns: int) -> None:
        self.points, self.seen, self.seen_ns = points, seen, seen_ns
        self.outcome: Future[None] = Future()
        self.passed, self.asked, self.asked_ns = 0.0, 0, 0  # checks, and the sample at the last one
        self.begin: Reference | None = None  # the reference from which it was planned
        self.begin_ns: int | None = None  # of that; None where it stands still until then

    def refuse(self, error: SstError) -> None:
        """Say why it is not followed."""
        self.outcome.set_exception(error)
