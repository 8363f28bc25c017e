# SPDX-License-Identifier: Apache-2.0
"""Time scaling: the factors by which a motion can be run faster or slower.

At `factor` times the speed rates grow by the factor and accelerations by its square. Torques of
inertia follow the square too, but weight and springs stay, and friction follows its own law: the
limits are tested on the dynamics themselves, not scaled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.peaks import maximum
from sst_ros.control.plan import MotionPlan
from sst_ros.control.reference import Triple
from sst_ros.dynamics import kernel
from sst_ros.mechanism.generic_math import scaled
from sst_ros.mechanism.geometry import Array

SLOWEST = 1e-4
"""Slower than this part of the highest factor is not looked for."""

_GRID = 120
_HALVINGS = 45
_DOUBLINGS = 40


@dataclass(frozen=True)
class TimeScaling:
    """Factors of speed at which the actuators can do a motion.

    Attributes:
        highest: the largest feasible factor; infinite where no limit is ever met, None where no
            factor is feasible.
        lowest: the smallest one of the range that ends at `highest`; 0 where the actuators can
            hold the manipulator all along the path.
        binding: which limit ends the range: torque, velocity or acceleration; empty if none does.

    """

    highest: float | None
    lowest: float
    binding: str


def time_scaling(plan: MotionPlan) -> TimeScaling:
    """Find the highest feasible factor of speed.

    The factors that torques allow are found on a grid first, then to rounding by bisection; a
    feasible range narrower than the grid, between others that are not, may be overlooked.
    """
    actuators = plan.scene.actuators
    caps = {"torque": math.inf}
    if actuators and actuators.velocity_limit is not None:
        fastest = max(abs(demand.velocity.value) for demand in plan.demands)
        caps["velocity"] = actuators.velocity_limit / fastest if fastest else math.inf
    if actuators and actuators.acceleration_limit is not None:
        hardest = max(abs(demand.acceleration.value) for demand in plan.demands)
        caps["acceleration"] = (
            math.sqrt(actuators.acceleration_limit / hardest) if hardest else math.inf
        )
    binding = min(caps, key=lambda name: caps[name])
    cap = caps[binding]
    if actuators is None or actuators.torque_limit is None:
        return TimeScaling(cap, 0.0, binding if math.isfinite(cap) else "")
    torques = _Torques(plan, actuators.torque_limit)
    top = min(cap, torques.top())
    grid = np.geomspace(SLOWEST * top, top, _GRID).tolist()
    last = _last(torques, grid, len(grid) - 1, feasible=True)
    if last is None:
        return TimeScaling(None, 0.0, "torque")
    highest = grid[last]
    if last < len(grid) - 1:
        highest, binding = _between(torques, highest, grid[last + 1]), "torque"
    elif math.isinf(cap):
        highest, binding = math.inf, ""
    first = _last(torques, grid, last, feasible=False)
    if first is not None:
        return TimeScaling(highest, _between(torques, grid[first + 1], grid[first]), binding)
    return TimeScaling(highest, 0.0 if torques.fit(0.0) else grid[0], binding)


class _Torques:
    """Torques of a motion at any speed against their limit."""

    def __init__(self, plan: MotionPlan, limit: float) -> None:
        self._plan, self._limit = plan, limit
        self._model = kernel.model_of(plan.scene)
        self._inverse = InverseDynamics(plan.scene)
        columns = [
            np.array([getattr(at, name) for at in plan.references]).T
            for name in ("quaternion", "body_rate", "body_acceleration")
        ]
        self._quaternion, self._rate, self._acceleration = columns

    def fit(self, factor: float) -> bool:
        """Whether no torque exceeds the limit, at samples or between them."""
        sampled = self.at_samples(factor)
        if np.abs(sampled).max() > self._limit:
            return False
        for leg, sign in product(range(3), (1.0, -1.0)):

            def torque(time: float, leg: int = leg, sign: float = sign) -> float:
                return sign * self.at(factor, time)[leg]

            peak = maximum(torque, self._plan.times, sign * sampled[leg], self._limit)
            if peak.value > self._limit:
                return False
        return True

    def top(self) -> float:
        """Return a factor beyond which nothing is looked for: three doublings above infeasible."""
        factor, beyond = 1.0, 0
        for _ in range(_DOUBLINGS):
            if beyond == 3:
                break
            exceeded = np.abs(self.at_samples(factor)).max() > self._limit
            beyond = beyond + 1 if exceeded else 0
            factor *= 2.0
        return factor

    def at_samples(self, factor: float) -> Array:
        """Torques [N m], shape (3, n)."""
        first, second, third = factor * self._rate
        x, y, z = factor * factor * self._acceleration
        qx, qy, qz, qw = self._quaternion
        found, _ = kernel.actuator_torque(
            self._model, (qx, qy, qz, qw), (first, second, third), (x, y, z)
        )
        return np.stack(np.broadcast_arrays(*found))

    def at(self, factor: float, time: float) -> Triple:
        """Torques [N m] at the time [s] of the motion as it is planned."""
        at = self._plan.motion.at(time)
        rate, acceleration = at.body_rate, at.body_acceleration
        return self._inverse.torque(
            at.quaternion, scaled(factor, rate), scaled(factor * factor, acceleration)
        )


def _last(torques: _Torques, grid: list[float], start: int, *, feasible: bool) -> int | None:
    """Index of the last factor up to `start` that is feasible, or is not; None if there is none."""
    for index in range(start, -1, -1):
        if torques.fit(grid[index]) == feasible:
            return index
    return None


def _between(torques: _Torques, fits: float, fails: float) -> float:
    """Return the feasible end of a change between two factors."""
    for _ in range(_HALVINGS):
        middle = 0.5 * (fits + fails)
        if torques.fit(middle):
            fits = middle
        else:
            fails = middle
    return float(fits)
