# SPDX-License-Identifier: Apache-2.0
"""Feasibility of a reference motion: demands, distances from limits, top speed.

All this is known before the motion is run. At `factor` times the speed rates grow by
the factor and accelerations by its square. Torques of inertia follow the square too,
but weight and springs stay, and friction has its own dependence: the limits are tested
on the dynamics themselves, not scaled.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import simpson
from scipy.optimize import brentq, minimize_scalar

from sst_ros.control.actuator_space import ActuatorSpaceMap, Reference, ReferenceMotion
from sst_ros.control.controller import InverseDynamics
from sst_ros.dynamics import kernel
from sst_ros.dynamics.model import SINGULAR_MU
from sst_ros.dynamics.reactions import SIZES, LoadFigures
from sst_ros.dynamics.traced_dynamics import LEGS
from sst_ros.errors import MotionRefused, Problem, SingularConfiguration
from sst_ros.mechanism.generic_math import multiply
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.torque_profile import FunctionTorque
from sst_ros.scene.yaml_document import values_at
from sst_ros.simulation.trajectory import RunRecord, Trajectory

PIECE_PARTS = 16  # parts of a piece of the motion; even, for Simpson's rule
SINGULAR_J2 = 1e-6  # det J2 within which a motion counts as singular
# Factors of speed between which ends are looked for.
SLOWEST = 1e-4
FASTEST = 1e8
_GRID = 360  # factors between them that are tried first
_FINE_INSTANTS = 33  # instants between two samples beside a peak of a reaction
DEMAND_UNITS = {
    "torque": "N m",
    "power": "W",
    "velocity": "rad/s",
    "acceleration": "rad/s^2",
}
"""Units of what a motion demands of an actuator.

Power is negative where the actuator brakes.
"""
_DEMANDED_TORQUES = slice(0, LEGS)  # places in the demands of a sample
# Share of a maximum by which another must exceed it: less is rounding.
_MAXIMUM_ROUNDING = 1e-13
_REFINEMENT = 1e-8  # of the time of a maximum, as a share of what it is sought in
# Places of the first of three, and of det J2, in what `_distances` measures.
_GAMMA_1 = 0
_SIN_MU_1 = 3
_BETA_1 = 6
_DET_J2 = 9


@dataclass(frozen=True)
class Peak:
    """A value and the time at which it is taken [s]."""

    value: float
    time: float


@dataclass(frozen=True)
class LimitDistance:
    """Distance of a motion to a limit."""

    key: str  # the limited quantity
    end: float  # value of the limit
    sign: float  # +1 for a lower limit, -1 for an upper one
    unit: str
    reached: Peak  # the value closest to the limit, or farthest beyond it
    refused: bool  # whether the motion is refused beyond it

    @property
    def least(self) -> float:
        """The smallest distance to the limit, negative beyond it."""
        return self.sign * (self.reached.value - self.end)

    @property
    def side(self) -> str:
        """Side of the limit on which the motion must stay."""
        return "above" if self.sign > 0.0 else "below"


@dataclass(frozen=True)
class MotionPlan:
    """A reference motion of a scene with the result of its check."""

    motion: ReferenceMotion
    # the motion where it was sampled, with the torques that it demands
    trajectory: Trajectory
    # by quantity of DEMAND_UNITS and leg, the largest, with their signs
    peaks: dict[str, list[Peak]]
    # those that the actuators have, by quantity of DEMAND_UNITS
    limits: dict[str, float]
    torque_rms: list[float]  # root of the mean square over the duration, by leg [N m]
    distances: tuple[LimitDistance, ...]  # from all limits
    problems: tuple[Problem, ...]  # reasons of a refusal; empty where it is feasible


def check_motion(motion: ReferenceMotion, scene: Scene) -> MotionPlan:
    """Examine a motion; raise MotionRefused, with every reason, where it is infeasible.

    A motion is infeasible where it leaves the stroke or the workspace, or exceeds a
    limit of the actuators. Extremes of the plan are sought between samples only where
    one could lie beyond a limit: that takes a tenth of the time of `examine_motion`.
    """
    plan = examine_motion(motion, scene, exact=False)
    if plan.problems:
        raise MotionRefused("motion", plan.problems)
    return plan


def examine_motion(
    motion: ReferenceMotion, scene: Scene, *, exact: bool = True
) -> MotionPlan:
    """Compute demands of a motion and its distances from all limits.

    Extremes are sought between samples, too; where the result need not be `exact`, only
    those that could lie beyond a limit. An external moment from a topic counts as zero;
    the lag of actuators is not included. Raises SingularConfiguration where the motion
    meets a singularity: no torque is defined there.
    """
    ends = pairwise(motion.pieces)
    piece_times = (
        np.linspace(begin, end, PIECE_PARTS, endpoint=False) for begin, end in ends
    )
    times = np.concatenate([*piece_times, motion.pieces[-1:]])
    desired = tuple(map(motion.at, times.tolist()))
    distances = tuple(_distances(motion, scene, times, desired, exact))
    limits = {}
    for name in DEMAND_UNITS:
        for limit in values_at(scene, f"actuators.{name}_limit"):
            limits[name] = limit
    inverse = InverseDynamics(scene)

    def measure(reference: Reference) -> tuple[float, ...]:
        """Quantities of DEMAND_UNITS, each of three actuators."""
        torque = inverse.reference_torque(reference)
        power = map(operator.mul, torque, reference.gamma_dot)
        return (*torque, *power, *reference.gamma_dot, *reference.gamma_ddot)

    samples, find = _sample(motion, measure, times, desired)
    torques = samples[:, _DEMANDED_TORQUES]
    peaks: dict[str, list[Peak]] = {}
    for quantity, name in enumerate(DEMAND_UNITS):
        floor = -math.inf if exact else limits.get(name, math.inf)
        peaks[name] = []
        for leg in range(LEGS):
            index = LEGS * quantity + leg
            highest = find(index, 1.0, floor)
            lowest = find(index, -1.0, floor)
            largest = max(highest, lowest, key=lambda peak: abs(peak.value))
            peaks[name].append(largest)
    return MotionPlan(
        motion=motion,
        trajectory=_trajectory_of(motion, scene, inverse, times, desired, torques),
        peaks=peaks,
        limits=limits,
        torque_rms=_torque_rms(times, torques),
        distances=distances,
        problems=tuple(_faults(distances, peaks, limits)),
    )


def _trajectory_of(
    motion: ReferenceMotion,
    scene: Scene,
    inverse: InverseDynamics,
    times: Array,
    desired: Sequence[Reference],
    torques: Array,
) -> Trajectory:
    """Return a motion as a trajectory, of references and torques at times."""

    def states(times: Array) -> Array:
        """Quaternions, body rates and torques of the motion, shape (n, 10)."""
        rows = []
        for reference in map(motion.at, times.tolist()):
            torque = inverse.reference_torque(reference)
            rows.append((*reference.quaternion, *reference.body_rate, *torque))
        return np.array(rows)

    # ends of pieces may be equal up to rounding
    t, rows = np.unique(times, return_index=True)
    quaternions = np.array([reference.quaternion for reference in desired])
    body_rates = np.array([reference.body_rate for reference in desired])
    law = FunctionTorque(lambda time: inverse.reference_torque(motion.at(time)))
    record = RunRecord(message="planned", law=law, dense=states)
    return Trajectory(
        scene, t, quaternions[rows], body_rates[rows], torques[rows], run=record
    )


def _torque_rms(times: Array, torques: Array) -> list[float]:
    """Return the root of the mean square of torques (n, 3) at times [N m], by leg.

    Each piece of the motion has PIECE_PARTS parts, and shares its ends with the next.
    """
    first_rows = np.arange(0, len(times) - 1, PIECE_PARTS)
    piece_rows = first_rows[:, None] + np.arange(PIECE_PARTS + 1)
    of_pieces = simpson(
        torques[piece_rows] ** 2, x=times[piece_rows][..., None], axis=1
    )
    rms: list[float] = np.sqrt(of_pieces.sum(axis=0) / times[-1]).tolist()
    return rms


def _sample(
    motion: ReferenceMotion,
    measure: Callable[[Reference], tuple[float, ...]],
    times: Array,
    desired: Sequence[Reference],
) -> tuple[Array, Callable[[int, float, float], Peak]]:
    """Return m numbers at n references, (n, m), and a function of their extremes.

    `measure` gives the numbers. The function takes the index of a number, a sign, +1
    for its highest value or -1 for its lowest, and the floor of `maximum` for the
    number times the sign.
    """
    samples = np.array(list(map(measure, desired)))

    def find(index: int, sign: float, floor: float) -> Peak:
        values = sign * samples[:, index]
        extreme = maximum(
            lambda time: sign * measure(motion.at(time))[index], times, values, floor
        )
        return Peak(sign * extreme.value, extreme.time)

    return samples, find


def maximum(
    function: Callable[[float], float],
    times: Array,
    values: Array,
    floor: float = -math.inf,
) -> Peak:
    """Return the maximum of a function of time of which samples are known.

    Every sample that no neighbour exceeds is a local maximum. It is refined between its
    neighbours if the function could exceed the best sample, and `floor`, there:
    extrapolated by its change to the lower neighbour. Times rise [s], shape (n,);
    values are those of the function there.
    """
    top = int(np.argmax(values))
    best = Peak(float(values[top]), float(times[top]))
    # The neighbours; an end has no other than itself.
    left = np.append(values[0], values[:-1])
    right = np.append(values[1:], values[-1])
    is_local_maximum = (values >= left) & (values >= right)
    extrapolated = 2.0 * values - np.minimum(left, right)
    to_exceed = max(best.value + _MAXIMUM_ROUNDING * abs(best.value), floor)
    for index in np.flatnonzero(is_local_maximum & (extrapolated > to_exceed)):
        begin = times[max(index - 1, 0)]
        end = times[min(index + 1, len(times) - 1)]
        refined = minimize_scalar(
            lambda time: -function(time),
            bounds=(begin, end),
            method="bounded",
            options={"xatol": _REFINEMENT * float(end - begin)},
        )
        if -refined.fun > best.value + _MAXIMUM_ROUNDING * abs(best.value):
            best = Peak(float(-refined.fun), float(refined.x))
    return best


def _distances(
    motion: ReferenceMotion,
    scene: Scene,
    times: Array,
    desired: Sequence[Reference],
    exact: bool,
) -> Iterator[LimitDistance]:
    """Yield the distances of a motion from all limits.

    Raises SingularConfiguration where the motion meets a singularity.
    """
    geometry = Geometry.of(scene)
    space = ActuatorSpaceMap(geometry)

    def measure(reference: Reference) -> tuple[float, ...]:
        """Gamma, sin(mu), beta and det J2, ten numbers.

        sin(mu) < 0 beyond a serial singularity.
        """
        posture = list(space.posture(*reference.quaternion))
        of_star = space.of_star(
            reference.quaternion, reference.body_rate, reference.body_acceleration
        )
        angles = zip(reference.gamma, of_star.gamma, strict=True)
        for leg, (gamma, gamma_of_star) in enumerate(angles):
            # On the other branch of the leg r_k has the opposite direction: gamma
            # differs by pi.
            if math.cos(gamma - gamma_of_star) < 0.0:
                posture[leg] = -posture[leg]  # sin(mu) of the leg
        return (*reference.gamma, *posture)

    samples, find = _sample(motion, measure, times, desired)

    def reach(index: int, end: float, sign: float, enforced: bool = True) -> Peak:
        """Return the value closest to a limit, or farthest beyond.

        Beyond a limit that is not `enforced` a motion is not refused.
        """
        floor = -math.inf
        if not exact:
            floor = -sign * end if enforced else math.inf
        return find(index, -sign, floor)

    def between(
        name: str, first: int, largest: Sequence[float], enforced: bool
    ) -> Iterator[LimitDistance]:
        """Yield the distances of an angle of each leg from 0 and from the largest."""
        for leg, most in enumerate(largest):
            for end, sign in ((0.0, 1.0), (most, -1.0)):
                reached = reach(first + leg, end, sign, enforced)
                key = f"{name}_{leg + 1}"
                yield LimitDistance(key, end, sign, "rad", reached, enforced)

    in_stroke = scene.stroke.at_end != "ignore"
    in_workspace = scene.workspace.at_edge != "ignore"
    yield from between("gamma", _GAMMA_1, geometry.arc.tolist(), in_stroke)
    yield from between("beta", _BETA_1, [geometry.beta_max] * LEGS, in_workspace)
    for leg in (1, 2, 3):
        low = reach(_SIN_MU_1 + leg - 1, SINGULAR_MU, 1.0)
        if low.value < SINGULAR_MU:
            cause = f"serial singularity of leg {leg} at t = {low.time:.9g} s, sin(mu)"
            raise SingularConfiguration(cause, low.value)
        yield LimitDistance(f"sin(mu_{leg})", 0.0, 1.0, "1", low, True)

    def determinant(time: float) -> float:
        return measure(motion.at(time))[_DET_J2]

    sign = math.copysign(1.0, samples[0, _DET_J2])
    nearest = reach(_DET_J2, sign * SINGULAR_J2, sign)
    if sign * nearest.value < SINGULAR_J2:
        time = nearest.time
        if sign * nearest.value <= 0.0:  # it is crossed before
            time = brentq(determinant, 0.0, nearest.time)
        cause = f"parallel singularity at t = {time:.9g} s, det J2"
        raise SingularConfiguration(cause, determinant(time))
    yield LimitDistance("det J2", 0.0, sign, "1", nearest, True)


def _faults(
    distances: Sequence[LimitDistance],
    peaks: dict[str, list[Peak]],
    limits: dict[str, float],
) -> Iterator[Problem]:
    for distance in distances:
        if distance.refused and distance.least < 0.0:
            reached = distance.reached
            limit_text = f"{distance.side} {distance.end:.9g} {distance.unit}"
            requirement = f"must stay {limit_text} (t = {reached.time:.9g} s)"
            yield Problem(distance.key, reached.value, requirement)
    for name, limit in limits.items():
        for leg, peak in enumerate(peaks[name], start=1):
            if abs(peak.value) > limit:
                requirement = (
                    f"exceeds the limit {limit:g} {DEMAND_UNITS[name]} at t ="
                    f" {peak.time:.9g} s"
                )
                yield Problem(f"{name}_{leg}", peak.value, requirement)


@dataclass(frozen=True)
class TimeScaling:
    """Factors of speed at which the actuators can do a motion.

    They range from `lowest` to `highest`. The lowest is 0 where the actuators can hold
    the manipulator all along the path; the highest is infinite where no limit is ever
    met, None where no factor is feasible. `binding` is the limit that ends the range:
    torque, velocity or acceleration; empty if none does.
    """

    highest: float | None
    lowest: float
    binding: str


def time_scaling(plan: MotionPlan) -> TimeScaling:
    """Find the highest feasible factor of speed.

    The factors that torques allow are found on a grid first, then to rounding; a
    feasible range narrower than the grid, between others that are not, may be
    overlooked.
    """
    limits = plan.limits
    torque_limit = plan.trajectory.scene.torque_limit
    caps = {"": math.inf}
    for name, power in (("velocity", 1.0), ("acceleration", 0.5)):
        largest = max(abs(peak.value) for peak in plan.peaks[name])
        if name in limits and largest:
            caps[name] = (limits[name] / largest) ** power
    highest, binding = min((cap, name) for name, cap in caps.items())
    if torque_limit is None:
        return TimeScaling(highest, 0.0, binding)
    excess = _excess(plan, torque_limit)
    find_end = partial(brentq, excess, xtol=1e-300, rtol=4.0 * np.finfo(float).eps)
    slowest = SLOWEST * min(highest, 1.0)
    grid = np.geomspace(slowest, min(highest, FASTEST), _GRID).tolist()
    fits = [excess(factor) <= 0.0 for factor in grid]
    if not any(fits):
        return TimeScaling(None, 0.0, "torque")
    last = int(np.flatnonzero(fits)[-1])
    if last < _GRID - 1:
        highest = find_end(grid[last], grid[last + 1])
        binding = "torque"
    too_slow = np.flatnonzero(np.logical_not(fits[:last]))
    if len(too_slow):
        last_too_slow = too_slow[-1]
        lowest = find_end(grid[last_too_slow], grid[last_too_slow + 1])
    elif excess(0.0) <= 0.0:
        lowest = 0.0
    else:
        lowest = grid[0]
    return TimeScaling(highest, lowest, binding)


def _excess(plan: MotionPlan, limit: float) -> Callable[[float], float]:
    """Return by how much a torque exceeds the limit [N m], as a function of the speed.

    The speed is a factor; where no torque exceeds the limit the number is <= 0.
    """
    scene = plan.trajectory.scene
    times = plan.trajectory.t
    model = kernel.model_of(scene)
    inverse = InverseDynamics(scene)
    quaternion: Any = tuple(plan.trajectory.quaternion.T)
    rate = plan.trajectory.body_rate.T
    references = map(plan.motion.at, times.tolist())
    acceleration = np.array([reference.body_acceleration for reference in references]).T

    def torque(factor: float, leg: int, sign: float, time: float) -> float:
        reference = plan.motion.at(time)
        torques = inverse.torque(
            reference.quaternion,
            multiply(factor, reference.body_rate),
            multiply(factor * factor, reference.body_acceleration),
        )
        return sign * torques[leg]

    def excess(factor: float) -> float:
        scaled_rate: Any = tuple(factor * rate)
        scaled_acceleration: Any = tuple(factor * factor * acceleration)
        torques, _ = kernel.actuator_torque(
            model, quaternion, scaled_rate, scaled_acceleration
        )
        sampled = np.stack(np.broadcast_arrays(*torques))
        largest = float(np.abs(sampled).max())
        for leg, sign in product(range(LEGS), (1.0, -1.0)):
            if largest <= limit:  # not above it yet
                signed_torque = partial(torque, factor, leg, sign)
                peak = maximum(signed_torque, times, sign * sampled[leg], limit)
                largest = max(largest, peak.value)
        return largest - limit

    return excess


def examine_reactions(plan: MotionPlan) -> dict[str, dict[str, LoadFigures]]:
    """Return peak and RMS of the reactions of a plan.

    They are ordered by kind of joint and `reactions.SIZES`. The motion is sampled
    again, finely, beside each largest sample: a peak is off by some 1e-5 of itself.
    """
    t = plan.trajectory.t
    windows = [t]
    for figures in plan.trajectory.reactions.figures.values():
        for size in SIZES:
            for top in np.searchsorted(t, figures[size].time):
                begin = max(int(top) - 1, 0)
                end = min(int(top) + 1, len(t) - 1)
                windows.append(np.linspace(t[begin], t[end], _FINE_INSTANTS))
    return plan.trajectory.at(np.unique(np.concatenate(windows))).reactions.figures


def plan_json(plan: MotionPlan, fastest: TimeScaling) -> str:
    """Write a plan for machines: SI units, null for what does not exist."""
    reactions: dict[str, dict[str, dict[str, Any]]] = {}
    for joint_kind, figures in examine_reactions(plan).items():
        reactions[joint_kind] = {}
        for size, loads in figures.items():
            reactions[joint_kind][size] = {
                figure: value.tolist() for figure, value in loads._asdict().items()
            }
    actuators: list[dict[str, Any]] = []
    for leg, rms in enumerate(plan.torque_rms):
        demands = {name: asdict(peaks[leg]) for name, peaks in plan.peaks.items()}
        actuators.append({**demands, "torque_rms": rms})
    highest = fastest.highest
    any_speed = highest is not None and math.isinf(highest)
    plan_document = {
        "scene": plan.trajectory.scene.name,
        "duration": plan.motion.duration,
        "feasible": not plan.problems,
        "problems": [str(problem) for problem in plan.problems],
        "limits": plan.limits,
        "actuators": actuators,
        "reactions": reactions,
        "distances": [
            {**asdict(distance), "least": distance.least} for distance in plan.distances
        ],
        "highest_speed": None if any_speed else highest,
        "any_speed": any_speed,
        "lowest_speed": fastest.lowest,
        "binding": fastest.binding,
    }
    return json.dumps(plan_document, indent=2)


def write_torques(plan: MotionPlan, path: Path, period: float) -> None:
    """Write the torques for `torque_player`.

    Each row is held for a period [s], and has the torques of its middle. The last row
    holds the manipulator where the motion ends.
    """
    inverse = InverseDynamics(plan.trajectory.scene)
    motion = plan.motion
    count = math.ceil(motion.duration / period - 1e-9)
    lines = ["time,tau_1,tau_2,tau_3"]
    for k in range(count + 1):
        middle = (k + 0.5) * period
        if k == count:
            middle = math.inf
        torque = inverse.reference_torque(motion.at(middle))
        lines.append(",".join(map(repr, (k * period, *torque))))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
