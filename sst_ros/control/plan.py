# SPDX-License-Identifier: Apache-2.0
"""Feasibility of a reference motion: torques, power, distances from limits, before it is run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import simpson
from scipy.optimize import brentq, minimize_scalar

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.dynamics.model import SINGULAR_MU
from sst_ros.errors import MotionRefused, Problem, SingularConfiguration
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import Actuators
from sst_ros.scene.scene import Scene

SAMPLES = 16
"""Parts of a piece of the motion; even, for Simpson's rule."""

SINGULAR_J2 = 1e-6
"""det J2 within which a motion counts as singular."""

UNITS = {"torque": "N m", "power": "W", "velocity": "rad/s", "acceleration": "rad/s^2"}
"""Of the peaks of an `ActuatorDemand`."""

_ROUNDING = 1e-13


@dataclass(frozen=True)
class Peak:
    """A value and the time at which it is taken [s]."""

    value: float
    time: float


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


@dataclass(frozen=True)
class MotionPlan:
    """A reference motion with the result of its check.

    Attributes:
        motion: the motion.
        scene: the manipulator.
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
    times = np.append(np.concatenate(list(parts)), motion.pieces[-1])
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
    problems = (*_beyond(distances), *_too_much(demands, scene.actuators))
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


def _beyond(distances: tuple[LimitDistance, ...]) -> Iterator[Problem]:
    for distance in distances:
        if distance.refused and distance.least < 0.0:
            side = "above" if distance.sign > 0.0 else "below"
            allowed = f"must stay {side} {distance.end:.9g} {distance.unit}"
            said = f"{allowed} (t = {distance.reached.time:.9g} s)"
            yield Problem(distance.key, distance.reached.value, said)


def _too_much(demands: list[ActuatorDemand], actuators: Actuators | None) -> Iterator[Problem]:
    for name, limit, unit in limits(actuators):
        for leg, demand in enumerate(demands):
            peak: Peak = getattr(demand, name)
            if abs(peak.value) > limit:
                allowed = f"exceeds the limit {limit:g} {unit} at t = {peak.time:.9g} s"
                yield Problem(f"{name}_{leg + 1}", peak.value, allowed)


def limits(actuators: Actuators | None) -> Iterator[tuple[str, float, str]]:
    """Yield the limits that the actuators have: name of the demand, limit, unit."""
    for name, unit in UNITS.items():
        limit: float | None = getattr(actuators, f"{name}_limit", None)
        if limit is not None:
            yield name, limit, unit


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
    high = 2.0 * values - below > max(best.value + _ROUNDING * abs(best.value), floor)
    summits = (values >= left) & (values >= right) & high
    for index in np.flatnonzero(summits):
        bounds = times[max(index - 1, 0)], times[min(index + 1, len(times) - 1)]
        options = {"xatol": 1e-8 * float(bounds[1] - bounds[0])}
        found = minimize_scalar(
            lambda time: -function(time), bounds=bounds, method="bounded", options=options
        )
        if -found.fun > best.value + _ROUNDING * abs(best.value):
            best = Peak(float(-found.fun), float(found.x))
    return best


def minimum(function: Callable[[float], float], times: Array, values: Array) -> Peak:
    """Return the minimum; see `maximum`."""
    found = maximum(lambda time: -function(time), times, -values)
    return Peak(-found.value, found.time)
