# SPDX-License-Identifier: Apache-2.0
"""Where a run stands, how far it can be trusted, and what a step takes."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

from sst_ros.integration.methods import Method
from sst_ros.scene.torque_profile import SineTorque, Torque, TorqueProfile
from sst_ros.state import QUATERNION, STAR_RATE, Vector3

_ERROR_MARGIN = 2.0
"""Factor on the distance of both solutions.

An error that only halves with the steps is twice as large.
"""
_STEP_ROUNDING = 8.0 * sys.float_info.epsilon
"""Error of a step by rounding, which a run of n steps has at least sqrt(n) times."""

PAIR_STEPS = 3
"""Steps that both solutions take over one step: one of its length, two of the half."""


class MethodChange(NamedTuple):
    """A change of method."""

    time: float  # [s]
    method: str  # the new one
    reason: str


class Point(NamedTuple):
    """Where a run stands: all that its next step and its error estimate depend on.

    A second solution goes through each step by two of half the length: its distance is
    the error. No order is assumed, as none holds where a torque jumps, a clamp or a
    contact bends the motion, or friction is sharp. Where the method has its order, the
    second solution is nearly exact, and the distance is the error; where each step
    loses its order, the error halves, and the distance is half of the error.
    """

    y: list[float]  # the solution
    z: list[float]  # the second one, by steps of half the length
    joints: tuple[float, ...]  # nine angles and nine rates of y
    method: Method
    h: float = math.inf  # longest next step [s]
    attempts: int = 0  # since the method was chosen
    steps: int = 0  # accepted since the start
    changes: tuple[MethodChange, ...] = ()

    @property
    def error(self) -> float:
        """Estimated global error of the orientation [rad]."""
        return estimate_error(orientation_distance(self.y, self.z), self.steps)

    @property
    def rate_error(self) -> float:
        """Estimated global error of the body rate [rad/s]."""
        # Relative to the rate, as rounding is.
        speed = max(1.0, math.hypot(*self.y[STAR_RATE]))
        distance = math.dist(self.y[STAR_RATE], self.z[STAR_RATE]) / speed
        return speed * estimate_error(distance, self.steps)


def estimate_error(distance: float, steps: int) -> float:
    """Estimate the error of a solution by a second one, of steps half as long."""
    return max(_ERROR_MARGIN * distance, _STEP_ROUNDING * math.sqrt(steps + 1.0))


def orientation_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Return the angle between the orientations of two states that are near [rad].

    q and -q are the same orientation.
    """
    q = y[QUATERNION]
    p = z[QUATERNION]
    return 2.0 * min(math.dist(q, p), math.dist(q, [-x for x in p]))


def state_distance(y: Sequence[float], z: Sequence[float]) -> float:
    """Return the distance of orientations [rad], or that of the others if larger.

    Others are all other numbers, relative to the rate, which counts as 1 rad/s at
    least. The distance is infinite where a number is not finite.
    """
    speed = max(1.0, math.hypot(*z[STAR_RATE]))
    distance_of_others = math.dist(y[STAR_RATE.start :], z[STAR_RATE.start :])
    distance = max(orientation_distance(y, z), distance_of_others / speed)
    return distance if math.isfinite(distance) else math.inf


class Period(NamedTuple):
    """A stretch of time: a tick, a control period, or a whole smooth motion."""

    start: float  # when it begins [s]
    h: float  # its length [s]
    torque: Torque  # one of `AppliedTorque.acting`
    moment: tuple[float, ...] = ()
    """External moment on the star in {B} [N m], empty where no topic gives one."""
    second_torque: Vector3 | None = None
    """Constant torques of the second solution [N m], None where they are the same."""


class Drive(NamedTuple):
    """What acts from outside over a period."""

    numbers: tuple[float, ...]
    """First torques [N m], phases of a sine [rad], or zeros where a function gives the
    torques; then the moment on the star in {B} [N m] where the scene takes one.
    """
    function: TorqueProfile | None = None  # torques that the steps evaluate
    start: float = 0.0  # time of the run at which that of the steps is zero [s]
    sine: SineTorque | None = None  # torques that are part of the traced equations


class Drives(NamedTuple):
    """What acts on both solutions."""

    first: Drive
    second: Drive | None  # None where it is the same


class Outcome(NamedTuple):
    """What a step from a point has given."""

    y: list[float]  # the solution at its end
    z: list[float]  # the second one
    joints: tuple[float, ...]  # of y, see `Point`
    size: float  # of the local error, infinite where a number is not finite
    is_far: bool  # from all limits: no joint can have reached one
    stages: Sequence[Any] = ()  # evaluated in it, for states inside


class Step(NamedTuple):
    """An accepted step, or the part of it before an event."""

    t: float  # when it begins, from the begin of the period [s]
    h: float  # its length [s]
    begin: Point
    end: Point
    drive: Drive  # what acts
    other: Drive | None  # on the second solution, None where it is the same
    steps: Any  # what has taken it: `MethodSteps` or `FunctionSteps`
    last: bool  # whether it ends with the period
    is_far: bool  # from all limits, see `Outcome`
    stages: Sequence[Any] = ()  # see `Outcome`

    @property
    def cost(self) -> int:
        """Evaluations of both solutions."""
        cost: int = self.steps.cost
        return PAIR_STEPS * cost

    def inside(self, x: float) -> list[float]:
        """Return the state x [s] after its begin, by a shorter step.

        The numbers are nan where the step has no finite result.
        """
        state: list[float] = self.steps.single(self.t, x, self.begin.y, self.drive)
        return state
