# SPDX-License-Identifier: Apache-2.0
"""Feasibility of a reference motion before it is run: demands, distances from limits, top speed.

At `factor` times the speed rates grow by the factor and accelerations by its square. Torques of
inertia follow the square too, but weight and springs stay, and friction has its own dependence: the
limits are tested on the dynamics themselves, not scaled.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import simpson
from scipy.optimize import brentq, minimize_scalar

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import SINGULAR_MU
from sst_ros.errors import MotionRefused, Problem, SingularConfiguration
from sst_ros.mechanism.generic_math import multiply
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import Actuators
from sst_ros.scene.scene import Scene

SAMPLES = 16
"""Parts of a piece of the motion; even, for Simpson's rule."""
SINGULAR_J2 = 1e-6
"""det J2 within which a motion counts as singular."""
SLOWEST = 1e-4
"""Slower than this part of the highest factor of speed is not looked for."""
UNITS = {"torque": "N m", "power": "W", "velocity": "rad/s", "acceleration": "rad/s^2"}
"""Of the peaks of an `ActuatorDemand`."""
_GRID, _HALVINGS, _DOUBLINGS = 120, 45, 40


@dataclass(frozen=True)
class Peak:
    """A value and the time at which it is taken [s]."""

    value: float
    time: float


def maximum(
    function: Callable[[float], float], times: Array, values: Array, floor: float = -math.inf
) -> Peak:
    """Return the maximum of a function of which samples are known.

    Every sample that no neighbour exceeds is a local maximum. It is refined between its neighbours
    if the function could exceed the best sample there: extrapolated by its change to the lower
    neighbour.

    Args:
        function: of time.
        times: of the samples, rising [s], shape (n,).
        values: the function there, shape (n,).
        floor: maxima that are certainly below it are not refined.

    """
    top = int(np.argmax(values))
    best = Peak(float(values[top]), float(times[top]))
    left, right = np.append(-np.inf, values[:-1]), np.append(values[1:], -np.inf)
    below = np.minimum(np.append(values[0], values[:-1]), np.append(values[1:], values[-1]))
    high = 2.0 * values - below > max(best.value + 1e-13 * abs(best.value), floor)
    summits = (values >= left) & (values >= right) & high
    for index in np.flatnonzero(summits):
        bounds = times[max(index - 1, 0)], times[min(index + 1, len(times) - 1)]
        options = {"xatol": 1e-8 * float(bounds[1] - bounds[0])}
        found = minimize_scalar(
            lambda time: -function(time), bounds=bounds, method="bounded", options=options
        )
        if -found.fun > best.value + 1e-13 * abs(best.value):
            best = Peak(float(-found.fun), float(found.x))
    return best


def minimum(function: Callable[[float], float], times: Array, values: Array) -> Peak:
    """Return the minimum; see `maximum`."""
    found = maximum(lambda time: -function(time), times, -values)
    return Peak(-found.value, found.time)


@dataclass(frozen=True)
class ActuatorDemand:
    """Demand of a motion on one actuator; values of the largest magnitude, with their signs.

    Attributes:
        torque: [N m].
        torque_rms: root of the mean square over the duration [N m].
        power: torque times rate [W]; negative where the actuator brakes.
        velocity, acceleration: [rad/s], [rad/s^2].

    """

    torque: Peak
    torque_rms: float
    power: Peak
    velocity: Peak
    acceleration: Peak


@dataclass(frozen=True)
class LimitDistance:
    """Distance of a motion to a limit.

    Attributes:
        key: the limited quantity.
        end: value of the limit.
        sign: +1 for a lower limit, -1 for an upper one.
        unit: of both.
        reached: the value closest to the limit, or farthest beyond it.
        refused: whether the motion is refused beyond it.

    """

    key: str
    end: float
    sign: float
    unit: str
    reached: Peak
    refused: bool

    @property
    def least(self) -> float:
        """The smallest distance to the limit, negative beyond it."""
        return self.sign * (self.reached.value - self.end)

    @property
    def side(self) -> str:
        """Side of the limit on which the motion must stay."""
        return "above" if self.sign > 0.0 else "below"

    @property
    def is_beyond(self) -> bool:
        """Whether the motion is refused for this limit."""
        return self.refused and self.least < 0.0


@dataclass(frozen=True)
class MotionPlan:
    """A reference motion of a scene with the result of its check.

    Attributes:
        times: where it was sampled [s], shape (n,).
        references: the motion there.
        torques: actuator torques there [N m], shape (n, 3).
        demands: on the actuators, by leg.
        distances: from all limits.
        problems: reasons of a refusal; empty where it is feasible.

    """

    motion: ReferenceMotion
    scene: Scene
    times: Array
    references: tuple[Reference, ...]
    torques: Array
    demands: tuple[ActuatorDemand, ...]
    distances: tuple[LimitDistance, ...]
    problems: tuple[Problem, ...]


def check_motion(motion: ReferenceMotion, scene: Scene) -> MotionPlan:
    """Examine a motion and raise if it is infeasible.

    Raises:
        MotionRefused: it leaves the stroke or the workspace, or exceeds a limit of the actuators;
            lists every reason.
        SingularConfiguration: it meets a singularity.

    """
    plan = examine_motion(motion, scene)
    if plan.problems:
        raise MotionRefused("motion", plan.problems)
    return plan


def examine_motion(motion: ReferenceMotion, scene: Scene) -> MotionPlan:
    """Compute demands of a motion and its distances from all limits, between samples too.

    An external moment from a topic counts as zero; the lag of actuators is not included.

    Raises:
        SingularConfiguration: the motion meets a singularity; no torque is defined there.

    """
    parts = (
        np.linspace(begin, end, SAMPLES, endpoint=False) for begin, end in pairwise(motion.pieces)
    )
    times = np.concatenate([*parts, motion.pieces[-1:]])
    desired = tuple(map(motion.at, times.tolist()))
    distances = tuple(_distances(motion, scene, times, desired))
    inverse = InverseDynamics(scene)
    asked: dict[str, Callable[[Reference], Sequence[float]]] = {
        "torque": inverse.reference_torque,
        "power": lambda at: np.multiply(inverse.reference_torque(at), at.gamma_dot).tolist(),
        "velocity": lambda at: at.gamma_dot,
        "acceleration": lambda at: at.gamma_ddot,
    }
    samples = {name: np.array(list(map(of, desired))) for name, of in asked.items()}
    pieces = np.arange(0, len(times) - 1, SAMPLES)[:, None] + np.arange(SAMPLES + 1)
    demands = []
    for leg in range(3):
        peaks = {}
        for name, of in asked.items():
            given = _component(motion, of, leg), times, samples[name][:, leg]
            peaks[name] = max(maximum(*given), minimum(*given), key=lambda peak: abs(peak.value))
        squares = simpson(samples["torque"][pieces, leg] ** 2, x=times[pieces], axis=1)
        rms = math.sqrt(squares.sum() / times[-1])
        demands.append(ActuatorDemand(torque_rms=rms, **peaks))
    problems = (*_faults(distances, demands, limits(scene.actuators)),)
    return MotionPlan(
        motion, scene, times, desired, samples["torque"], tuple(demands), distances, problems
    )


def _component(
    motion: ReferenceMotion, of: Callable[[Reference], Sequence[float]], index: int
) -> Callable[[float], float]:
    """Return one of the numbers of a reference as a function of time."""
    return lambda time: of(motion.at(time))[index]


def _distances(
    motion: ReferenceMotion, scene: Scene, times: Array, desired: tuple[Reference, ...]
) -> Iterator[LimitDistance]:
    geometry = Geometry.of(scene)
    coordinates = ActuatorSpaceMap(geometry)

    def measure(at: Reference) -> tuple[float, ...]:
        """Gamma, sin(mu), beta and det J2, ten numbers."""
        return (*at.gamma, *_posture(coordinates, at))

    values = np.array([measure(at) for at in desired]).T
    given = [(_component(motion, measure, i), times, row) for i, row in enumerate(values)]
    ranges = (
        ("gamma", 0, geometry.arc.tolist(), scene.stroke.at_end != "ignore"),
        ("beta", 6, [geometry.beta_max] * 3, scene.workspace.at_edge != "ignore"),
    )
    for name, first, ends, held in ranges:
        for leg, end in enumerate(ends):
            key, course = f"{name}_{leg + 1}", given[first + leg]
            yield LimitDistance(key, 0.0, 1.0, "rad", minimum(*course), held)
            yield LimitDistance(key, end, -1.0, "rad", maximum(*course), held)
    for leg in range(3):
        low = minimum(*given[3 + leg])
        if low.value < SINGULAR_MU:
            said = f"serial singularity of leg {leg + 1} at t = {low.time:.9g} s, sin(mu)"
            raise SingularConfiguration(said, low.value)
        yield LimitDistance(f"sin(mu_{leg + 1})", 0.0, 1.0, "1", low, True)
    determinant, sign = given[9][0], 1.0 if values[9, 0] > 0.0 else -1.0
    low = minimum(lambda time: sign * determinant(time), times, sign * values[9])
    if low.value < SINGULAR_J2:
        end = low.time if low.value > 0.0 else brentq(determinant, 0.0, low.time)
        said = f"parallel singularity at t = {end:.9g} s, det J2"
        raise SingularConfiguration(said, determinant(end))
    yield LimitDistance("det J2", 0.0, sign, "1", Peak(sign * low.value, low.time), True)


def _posture(coordinates: ActuatorSpaceMap, at: Reference) -> tuple[float, ...]:
    """See `ActuatorSpaceMap.posture`; beyond a serial singularity the leg's sine is negative."""
    found = list(coordinates.posture(at.quaternion))
    turned = coordinates.of_star(at.quaternion, at.body_rate, at.body_acceleration).gamma
    for leg in range(3):
        # On the other branch of the leg r_k has the opposite direction: gamma differs by pi.
        if math.cos(at.gamma[leg] - turned[leg]) < 0.0:
            found[leg] = -found[leg]
    return tuple(found)


def _faults(
    distances: Sequence[LimitDistance], demands: Sequence[ActuatorDemand], most: dict[str, float]
) -> Iterator[Problem]:
    for distance in distances:
        if distance.is_beyond:
            allowed = f"must stay {distance.side} {distance.end:.9g} {distance.unit}"
            said = f"{allowed} (t = {distance.reached.time:.9g} s)"
            yield Problem(distance.key, distance.reached.value, said)
    for name, limit in most.items():
        for leg, demand in enumerate(demands):
            peak: Peak = getattr(demand, name)
            if abs(peak.value) > limit:
                allowed = f"exceeds the limit {limit:g} {UNITS[name]} at t = {peak.time:.9g} s"
                yield Problem(f"{name}_{leg + 1}", peak.value, allowed)


def limits(actuators: Actuators | None) -> dict[str, float]:
    """Return the limits that the actuators have, by the name of the demand."""
    found = {name: getattr(actuators, f"{name}_limit", None) for name in UNITS}
    return {name: limit for name, limit in found.items() if limit is not None}


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
    for name, limit in limits(plan.scene.actuators).items():
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
        self._model, self._inverse = kernel.model_of(plan.scene), InverseDynamics(plan.scene)
        self._quaternion, self._rate, self._acceleration = (
            np.array([getattr(at, name) for at in plan.references]).T
            for name in ("quaternion", "body_rate", "body_acceleration")
        )

    def fit(self, factor: float) -> bool:
        """Whether no torque exceeds the limit, at samples or between them."""
        times, sampled = self._plan.times, self._at_samples(factor)
        if np.abs(sampled).max() > self._limit:
            return False
        peaks = (
            maximum(partial(self._at, factor, leg, sign), times, sign * sampled[leg], self._limit)
            for leg, sign in product(range(3), (1.0, -1.0))
        )
        return all(peak.value <= self._limit for peak in peaks)

    def top(self) -> float:
        """Return a factor beyond which nothing is looked for: three doublings above infeasible."""
        factor, beyond = 1.0, 0
        for _ in range(_DOUBLINGS):
            if beyond == 3:
                break
            exceeded = np.abs(self._at_samples(factor)).max() > self._limit
            beyond = beyond + 1 if exceeded else 0
            factor *= 2.0
        return factor

    def _at_samples(self, factor: float) -> Array:
        """Torques [N m], shape (3, n)."""
        motion = self._quaternion, factor * self._rate, factor * factor * self._acceleration
        star: Any = [tuple(rows) for rows in motion]
        found, _ = kernel.actuator_torque(self._model, *star)
        return np.stack(np.broadcast_arrays(*found))

    def _at(self, factor: float, leg: int, sign: float, time: float) -> float:
        """Torque [N m] of a leg, times the sign, at a time [s] of the motion as it is planned."""
        at = self._plan.motion.at(time)
        rate = multiply(factor, at.body_rate)
        acceleration = multiply(factor * factor, at.body_acceleration)
        return sign * self._inverse.torque(at.quaternion, rate, acceleration)[leg]


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
    known = limits(plan.scene.actuators)
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
    unit = f" [{distance.unit}]" if distance.unit != "1" else ""
    name = f"{distance.key} {distance.side} {distance.end:.6g}{unit}"
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
    if any(distance.is_beyond for distance in plan.distances):
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
            "limits": limits(plan.scene.actuators),
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
    inverse, motion = InverseDynamics(plan.scene), plan.motion
    count = math.ceil(motion.duration / period - 1e-9)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "tau_1", "tau_2", "tau_3"])
        for k in range(count + 1):
            torque = inverse.reference_torque(
                motion.at((k + 0.5) * period if k < count else math.inf)
            )
            writer.writerow([repr(k * period), *map(repr, torque)])
