# SPDX-License-Identifier: Apache-2.0
"""What a checked motion asks for, as a table, as JSON and as torques; how fast it can be run.

At `factor` times the speed rates grow by the factor and accelerations by its square. Torques of
inertia follow the square too, but weight and springs stay, and friction has its own dependence: the
limits are tested on the dynamics themselves, not scaled.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np

from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.plan import UNITS, LimitDistance, MotionPlan, limits, maximum
from sst_ros.dynamics import kernel
from sst_ros.mechanism.generic_math import multiply
from sst_ros.mechanism.geometry import Array
from sst_ros.state import Vector3

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
    caps, torque_limit = {"torque": math.inf}, plan.scene.torque_limit
    for name, limit, _ in limits(plan.scene.actuators):
        largest = max(abs(getattr(demand, name).value) for demand in plan.demands)
        if name != "torque":
            ratio = limit / largest if largest else math.inf
            caps[name] = ratio if name == "velocity" else math.sqrt(ratio)
    binding = min(caps, key=lambda name: caps[name])
    cap = caps[binding]
    if torque_limit is None:
        return TimeScaling(cap, 0.0, binding if math.isfinite(cap) else "")
    torques = _Torques(plan, torque_limit)

    def bisect(fits: float, fails: float) -> float:
        """Return the feasible end of a change between two factors."""
        for _ in range(_HALVINGS):
            middle = 0.5 * (fits + fails)
            fits, fails = (middle, fails) if torques.fit(middle) else (fits, middle)
        return fits

    top = min(cap, torques.top())
    grid = np.geomspace(SLOWEST * top, top, _GRID)
    fits = np.array([torques.fit(factor) for factor in grid.tolist()])
    if not fits.any():
        return TimeScaling(None, 0.0, "torque")
    last = int(np.flatnonzero(fits)[-1])
    highest = float(grid[last])
    if last < len(grid) - 1:
        highest, binding = bisect(highest, float(grid[last + 1])), "torque"
    elif math.isinf(cap):
        highest, binding = math.inf, ""
    slow = np.flatnonzero(~fits[:last])
    if len(slow):
        lowest = bisect(float(grid[slow[-1] + 1]), float(grid[slow[-1]]))
    else:
        lowest = 0.0 if torques.fit(0.0) else float(grid[0])
    return TimeScaling(highest, lowest, binding)


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

    def at(self, factor: float, time: float) -> Vector3:
        """Torques [N m] at the time [s] of the motion as it is planned."""
        at = self._plan.motion.at(time)
        rate, acceleration = at.body_rate, at.body_acceleration
        return self._inverse.torque(
            at.quaternion, multiply(factor, rate), multiply(factor * factor, acceleration)
        )


def plan_table(plan: MotionPlan, fastest: TimeScaling) -> str:
    """Write a plan for people."""
    lines = [
        f"{plan.scene.name}: {plan.motion.duration:g} s, {len(plan.times)} samples and the "
        "extremes between them",
        "",
        _row("", ["actuator 1", "actuator 2", "actuator 3"], "limit"),
        *_demands(plan),
        "",
        _row("distance to an end", ["least", "at t [s]"]),
        *map(_distance, plan.distances),
        "",
        *_verdict(plan, fastest),
    ]
    return "\n".join(lines) + "\n"


def _demands(plan: MotionPlan) -> Iterator[str]:
    known = {name: limit for name, limit, _ in limits(plan.scene.actuators)}
    for name, unit in UNITS.items():
        peaks, limit = [getattr(demand, name) for demand in plan.demands], known.get(name)
        end = "" if limit is None else f"{limit:g}"
        yield _row(f"peak {name} [{unit}]", [f"{peak.value:.6g}" for peak in peaks], end)
        yield _row("  at t [s]", [f"{peak.time:.6g}" for peak in peaks])
        if limit is not None:
            yield _row("  margin", [f"{1.0 - abs(peak.value) / limit:.1%}" for peak in peaks])
        if name == "torque":
            yield _row("RMS torque [N m]", [f"{demand.torque_rms:.6g}" for demand in plan.demands])


def _row(name: str, cells: Sequence[str], end: str = "") -> str:
    return f"{name:<28}{''.join(f'{cell:>14}' for cell in cells)}{end:>14}".rstrip()


def _distance(distance: LimitDistance) -> str:
    side = "above" if distance.sign > 0.0 else "below"
    unit = f" [{distance.unit}]" if distance.unit != "1" else ""
    name = f"{distance.key} {side} {distance.end:.6g}{unit}"
    note = "" if distance.refused else "   ignored"
    return _row(name, [f"{distance.least:.6g}", f"{distance.reached.time:.6g}"]) + note


def _verdict(plan: MotionPlan, fastest: TimeScaling) -> Iterator[str]:
    for problem in plan.problems:
        yield f"refused: {problem}"
    if plan.scene.moment is not None and plan.scene.moment.topic:
        yield "The external moment comes from a topic; it counts as zero here."
    if plan.scene.lags:
        yield "The actuators lag; commands that make up for it may exceed the torques."
    yield "feasible" if not plan.problems else "not feasible"
    if any(distance.refused and distance.least < 0.0 for distance in plan.distances):
        yield "At no speed: the path itself leaves what is allowed."
    elif fastest.highest is None:
        yield "At no speed: the torque limit is too small for this path."
    elif math.isinf(fastest.highest):
        yield "At any speed: the scene has no limit that it could meet."
    else:
        duration = plan.motion.duration / fastest.highest
        yield (
            f"Highest speed {fastest.highest:.9g} times as planned, in {duration:.9g} s;"
            f" then the {fastest.binding} limit is met."
        )
    if fastest.highest is not None and fastest.lowest > 0.0:
        yield (
            f"Slower than {fastest.lowest:.9g} times as planned it is not feasible either: the"
            " torque limit is too small to rest everywhere on this path."
        )


def plan_json(plan: MotionPlan, fastest: TimeScaling) -> str:
    """Write a plan for machines: SI units, null for what does not exist."""
    highest = fastest.highest
    return json.dumps(
        {
            "scene": plan.scene.name,
            "duration": plan.motion.duration,
            "feasible": not plan.problems,
            "problems": [str(problem) for problem in plan.problems],
            "limits": {name: limit for name, limit, _ in limits(plan.scene.actuators)},
            "actuators": [asdict(demand) for demand in plan.demands],
            "distances": [{**asdict(one), "least": one.least} for one in plan.distances],
            "highest_speed": None if highest is None or math.isinf(highest) else highest,
            "any_speed": highest is not None and math.isinf(highest),
            "lowest_speed": fastest.lowest,
            "binding": fastest.binding,
        },
        indent=2,
    )


def write_torques(plan: MotionPlan, path: Path, period: float) -> None:
    """Write the torques for `torque_player`: each row, held for a period [s], is its middle's.

    The last row holds the manipulator where the motion ends.
    """
    inverse = InverseDynamics(plan.scene)
    count = math.ceil(plan.motion.duration / period - 1e-9)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "tau_1", "tau_2", "tau_3"])
        for k in range(count + 1):
            at = plan.motion.at((k + 0.5) * period if k < count else math.inf)
            torque = inverse.reference_torque(at)
            writer.writerow([repr(k * period), *map(repr, torque)])
