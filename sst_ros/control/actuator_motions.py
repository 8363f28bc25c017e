# SPDX-License-Identifier: Apache-2.0
"""Reference motions of the actuators, which the star follows: point to point, sweeps, waypoints.

Through waypoints, and through the samples of a recording, goes one quintic a segment: position,
velocity and acceleration at both ends make it. Where a velocity or an acceleration is left open,
all open ones together minimise the integral of the jerk squared: with positions alone that is the
quintic spline with four continuous derivatives.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from sst_ros.control.actuator_space import ActuatorSpaceMap, follow_assembly
from sst_ros.control.reference import (
    PIECES,
    Reference,
    ReferenceMotion,
    equal_pieces,
    minimum_jerk,
    minimum_jerk_over,
)
from sst_ros.errors import InputError, Problem, SingularConfiguration
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import ZERO, axpy, multiply, triple
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.loads import Sweep, ToAngles
from sst_ros.state import Quaternion, Vector3

Path = Callable[[float], tuple[Vector3, Vector3, Vector3]]
"""Time [s] to gamma [rad], gamma_dot [rad/s], gamma_ddot [rad/s^2]."""

STEP = 0.03
"""Distance in gamma [rad] between orientations that are kept."""
LONGEST = 100.0
"""Longest path in gamma [rad] within a piece of a motion."""
NEAR = 0.1
"""Largest distance of a first point at time 0 from the start [rad]."""
SAMPLES_A_PIECE = 8
_SAMPLES = 16
OpenPoints = Sequence[Sequence[float] | None]


class ActuatorMotion(ReferenceMotion):
    """A path of the actuators, and the orientation of one assembly mode along it.

    Orientations are computed once along the path, by `continuation` in steps that cannot leave the
    assembly mode; any other orientation is computed from the nearest of these. `at` therefore does
    not depend on earlier calls.

    Args:
        geometry: base triangle and star.
        path: gamma and its two derivatives between time 0 and the duration.
        pieces: see `ReferenceMotion`.
        start: quaternion (x, y, z, w) of {E} in {B} at time 0.

    Raises:
        SingularConfiguration: the path meets a parallel singularity; the message has the time.
        InputError: a piece of the path is longer than LONGEST.
        AssemblyError: start is not an orientation of the manipulator at the begin of the path.

    """

    def __init__(
        self, geometry: Geometry, path: Path, pieces: tuple[float, ...], start: Quaternion
    ) -> None:
        super().__init__(pieces[-1], pieces)
        self._path, self._geometry = path, geometry
        self._coordinates = ActuatorSpaceMap(geometry)
        self._times = list(_space(path, pieces))
        self._gammas = [path(time)[0] for time in self._times]
        try:
            branch = continuation.follow(geometry, self._gammas, rotation_matrix(start))
        except continuation.BranchEnds as error:
            time = self._times[error.row]
            said = f"parallel singularity before t = {time:.9g} s, least singular value of J2"
            raise SingularConfiguration(said, error.measure) from error
        self._reach = (continuation.SAFE * branch.sigma**2).tolist()
        self._rotations = branch.rotation
        self._quaternions = list(_alike(quaternion_of(branch.rotation).tolist(), start))

    def _inside(self, time: float) -> Reference:
        gamma, gamma_dot, gamma_ddot = self._path(time)
        index = max(bisect_right(self._times, time) - 1, 0)
        near = self._quaternions[index]
        if math.dist(gamma, self._gammas[index]) > self._reach[index]:
            there = continuation.advance(
                self._geometry, self._rotations[index], self._gammas[index], gamma
            )
            (near,) = _alike([quaternion_of(there).tolist()], near)
        try:
            return self._coordinates.of_actuators(near, gamma, gamma_dot, gamma_ddot)
        except ArithmeticError:
            said = f"serial singularity at t = {time:.9g} s, sin(mu)"
            raise SingularConfiguration(said, 0.0) from None


def _space(path: Path, pieces: tuple[float, ...]) -> Iterator[float]:
    """Yield times from the first to the last between which gamma moves by no more than STEP."""
    yield pieces[0]
    last, before = path(pieces[0])[0], pieces[0]
    for begin, end in pairwise(pieces):
        rough = [path(time)[0] for time in np.linspace(begin, end, _SAMPLES + 1).tolist()]
        length = sum(math.dist(a, b) for a, b in pairwise(rough))
        if not length < LONGEST:
            allowed = f"must be less than {LONGEST:g} rad between {begin:.9g} s and {end:.9g} s"
            raise InputError("motion", [Problem("path length of gamma", length, allowed)])
        count = max(_SAMPLES, math.ceil(2.0 * length / STEP))
        for time in np.linspace(begin, end, count + 1).tolist()[1:]:
            here = path(time)[0]
            if math.dist(here, last) > STEP and before != pieces[0]:
                yield before
                last = path(before)[0]
            before = time
    yield pieces[-1]


def _alike(quaternions: list[list[float]], before: Quaternion) -> Iterator[Quaternion]:
    """Yield quaternions with signs that change as little as they can."""
    for x, y, z, w in quaternions:
        same = x * before[0] + y * before[1] + z * before[2] + w * before[3] >= 0.0
        before = (x, y, z, w) if same else (-x, -y, -z, -w)
        yield before


def straight_path(start: Vector3, goal: ToAngles) -> Path:
    """From one gamma straight to another, with minimum jerk."""
    span = axpy(1.0, goal.gamma, -1.0, start)

    def path(time: float) -> tuple[Vector3, Vector3, Vector3]:
        s, rate, acceleration = minimum_jerk_over(time, goal.duration)
        return axpy(1.0, start, s, span), multiply(rate, span), multiply(acceleration, span)

    return path


def sweep_path(sweep: Sweep, centre: Vector3) -> tuple[Path, tuple[float, ...]]:
    """Sines that fade in and out, and pieces of a quarter of a period or less."""
    last = sweep.last_frequency or sweep.frequency
    slopes = [(b - a) / sweep.duration for a, b in zip(sweep.frequency, last, strict=True)]
    rows = list(zip(centre, sweep.amplitude, sweep.frequency, slopes, strict=True))

    def path(time: float) -> tuple[Vector3, Vector3, Vector3]:
        e, e1, e2 = _fading(time, sweep.fade, sweep.duration)
        p, v, a = [], [], []
        for middle, amplitude, first, slope in rows:
            angle, frequency = time * (first + 0.5 * slope * time), first + slope * time
            s, c = math.sin(angle), math.cos(angle)
            # The sine and its derivatives by time, times the fading and its own.
            s1, s2 = frequency * c, slope * c - frequency * frequency * s
            p.append(middle + amplitude * e * s)
            v.append(amplitude * (e1 * s + e * s1))
            a.append(amplitude * (e2 * s + 2.0 * e1 * s1 + e * s2))
        return triple(p), triple(v), triple(a)

    fastest = max(map(abs, (*sweep.frequency, *last)))
    quarters = math.ceil(fastest * sweep.duration / (0.5 * math.pi))
    fades = (sweep.fade, sweep.duration - sweep.fade)
    pieces = {*equal_pieces(sweep.duration, max(quarters, 2 * PIECES)), *fades}
    return path, tuple(sorted(pieces))


def _fading(time: float, fade: float, duration: float) -> tuple[float, float, float]:
    """Fading in and out, between 0 and 1, with its derivatives by time."""
    if fade <= time <= duration - fade:
        return 1.0, 0.0, 0.0
    e, e1, e2 = minimum_jerk(min(time, duration - time) / fade)
    return e, (e1 if time < fade else -e1) / fade, e2 / (fade * fade)


def through_points(
    geometry: Geometry,
    start: Quaternion,
    times: Sequence[float],
    positions: Sequence[Sequence[float]],
    velocities: OpenPoints | None = None,
    accelerations: OpenPoints | None = None,
    begin: tuple[Vector3, Vector3] = (ZERO, ZERO),
) -> ReferenceMotion:
    """Return the motion of the actuators through points, quintic between them.

    The fields of trajectory_msgs/JointTrajectory, rows in the order of the legs. A first point
    after time 0 is reached from the start; one at time 0 is the start itself, at rest. The motion
    ends at rest. Rates and accelerations that are not given (no rows, or None or nothing in place
    of a row) are zero at the ends and chosen for minimum jerk between them.

    Args:
        geometry: base triangle and star.
        start: quaternion (x, y, z, w) of {E} in {B} from which the motion begins.
        times: of the points [s], n >= 1.
        positions: gamma [rad], n rows of three.
        velocities: gamma_dot [rad/s], n rows.
        accelerations: gamma_ddot [rad/s^2], n rows.
        begin: gamma_dot and gamma_ddot at the start, where the first point comes after time 0.

    Raises:
        InputError: no points, wrong shapes, numbers that are not finite, times that do not rise,
            a beginning or an end that moves, a first point that is not where the motion starts.
        SingularConfiguration: the motion meets a parallel singularity.

    """
    count = len(times)
    problems: list[Problem] = []
    rows = [
        _rows("times", [[time] for time in times], count, 1, problems),
        _rows("positions", positions, count, 3, problems),
        *(
            _rows(name, [()] * count if given is None else given, count, 3, problems)
            for name, given in (("velocities", velocities), ("accelerations", accelerations))
        ),
    ]
    if not count:
        problems.append(Problem("points", 0, "must be one or more"))
    if problems:
        raise InputError("trajectory", problems)
    at, gamma, rates, seconds = map(np.array, rows)
    at = at.ravel()
    problems += _faults(at, rates)
    if problems:
        raise InputError("trajectory", problems)
    here = kinematics.inverse(geometry, rotation_matrix(start))[0]
    if at[0] > 0.0:
        at, gamma = np.append(0.0, at), np.vstack([here, gamma])
        rates, seconds = np.vstack([begin[0], rates]), np.vstack([begin[1], seconds])
    elif np.abs(gamma[0] - here).max() > NEAR:
        said = "must be within {:g} rad of the start, ({:.6g}, {:.6g}, {:.6g}) rad"
        problem = Problem("positions[0]", gamma[0].tolist(), said.format(NEAR, *here))
        raise InputError("trajectory", [problem])
    for ends in (rates[0], rates[-1], seconds[0], seconds[-1]):
        ends[np.isnan(ends)] = 0.0
    begun = follow_assembly(geometry, start, here, gamma[0])
    return ActuatorMotion(
        geometry, cast("Path", Quintic(at, gamma, rates, seconds).at), tuple(at.tolist()), begun
    )


def through_samples(
    geometry: Geometry, start: Quaternion, times: Array, positions: Array, velocities: Array
) -> ReferenceMotion:
    """Return the motion through dense samples, quintic between them; it may begin and end moving.

    Args:
        geometry: base triangle and star.
        start: quaternion (x, y, z, w) of {E} in {B} at the first sample.
        times: of the samples, rising [s], shape (n,); the motion begins with the first.
        positions: gamma [rad], shape (n, 3).
        velocities: gamma_dot [rad/s], shape (n, 3).

    Raises:
        AssemblyError: the samples are of another manipulator.
        SingularConfiguration: the motion meets a parallel singularity.

    """
    times = times - times[0]
    gamma = np.unwrap(positions, axis=0)
    free = np.full_like(gamma, np.nan)
    # Samples lie much denser than the motion turns: several make one piece.
    pieces = (*times[:-1:SAMPLES_A_PIECE].tolist(), float(times[-1]))
    spline = Quintic(times, gamma, velocities, free)
    return ActuatorMotion(geometry, cast("Path", spline.at), pieces, start)


def _rows(
    name: str, rows: OpenPoints, count: int, size: int, problems: list[Problem]
) -> list[list[float]]:
    """Read rows of numbers; one that is open becomes NaN. What is wrong joins the problems."""
    if len(rows) != count:
        problems.append(Problem(name, len(rows), f"must have a row for each of {count} points"))
    found = []
    may_be_open = name in ("velocities", "accelerations")
    for index, row in enumerate(rows):
        numbers = [] if row is None else [float(number) for number in row]
        if not numbers and may_be_open:
            numbers = [math.nan] * size
        elif len(numbers) != size or not all(map(math.isfinite, numbers)):
            allowed = f"must be {size} finite numbers" if size > 1 else "must be finite"
            problems.append(Problem(f"{name}[{index}]", numbers, allowed))
        found.append(numbers)
    return found


def _faults(at: Array, rates: Array) -> Iterator[Problem]:
    """Yield what is wrong with points of finite numbers."""
    for index in np.flatnonzero(at[1:] <= at[:-1]) + 1:
        allowed = f"must be > {at[index - 1]:g} s, that of the point before"
        yield Problem(f"times[{index}]", float(at[index]), allowed)
    if at[0] < 0.0 or (at[0] == 0.0 and len(at) == 1):
        yield Problem("times[0]", float(at[0]), "must be >= 0 s, that of a single point > 0 s")
    for end in {0, len(at) - 1} if at[0] == 0.0 else {len(at) - 1}:
        if np.nan_to_num(rates[end]).any():
            allowed = "must be zero: a motion begins and ends at rest"
            yield Problem(f"velocities[{end}]", rates[end].tolist(), allowed)


# Power coefficients c_0 ... c_5 on [0, 1] of (p0, v0, a0, p1, v1, a1), derivatives by that time.
_POWERS = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
        [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
        [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
    ]
)


class Quintic:
    """A path of one or more numbers, quintic between points.

    Args:
        times: of the points, rising [s], shape (n,), n >= 2.
        positions: shape (n, m).
        velocities, accelerations: shape (n, m); NaN where they are left open.

    """

    def __init__(
        self,
        times: ArrayLike,
        positions: ArrayLike,
        velocities: ArrayLike,
        accelerations: ArrayLike,
    ) -> None:
        at = np.asarray(times, dtype=float)
        nodes = np.stack(
            [np.array(x, dtype=float) for x in (positions, velocities, accelerations)], axis=1
        )
        self.times: list[float] = at.tolist()
        lengths = np.diff(at)
        _complete(nodes, lengths)
        scale = np.stack([np.ones_like(lengths), lengths, lengths * lengths], axis=1)
        local = np.concatenate(
            [nodes[:-1] * scale[..., None], nodes[1:] * scale[..., None]], axis=1
        )
        # By segment and number: coefficients in the time of the segment, from 0 to 1.
        self._segments = np.einsum("ij,njm->nmi", _POWERS, local).tolist()
        self._lengths: list[float] = lengths.tolist()

    def at(self, time: float) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
        """Position, velocity and acceleration at a time between the first point and the last."""
        index = min(max(bisect_right(self.times, time) - 1, 0), len(self._lengths) - 1)
        h = self._lengths[index]
        u = (time - self.times[index]) / h
        p, v, a = [], [], []
        for c0, c1, c2, c3, c4, c5 in self._segments[index]:
            p.append(c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5)))))
            v.append((c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) / h)
            a.append((2.0 * c2 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))) / (h * h))
        return tuple(p), tuple(v), tuple(a)


def _complete(nodes: Array, lengths: Array) -> None:
    """Fill in what is open in nodes, shape (n, 3, m), in place: the least integral of jerk^2."""
    usual = float(np.median(lengths))
    # A velocity times the usual length has the size of a position: the system stays well scaled.
    scale = np.array([1.0, usual, usual * usual])[:, None]
    forms = np.stack([_jerk(h) for h in (lengths / usual).tolist()])
    places = 3 * np.arange(len(lengths))[:, None] + np.arange(6)  # of the numbers at its ends
    ends = (
        np.broadcast_to(places[:, :, None], forms.shape),
        np.broadcast_to(places[:, None], forms.shape),
    )
    hessian = csc_array((forms.ravel(), tuple(map(np.ravel, ends))))
    for column in range(nodes.shape[2]):
        x = (nodes[:, :, column] * scale.T).ravel()
        missing = np.isnan(x)
        if missing.any():
            x[missing] = 0.0
            rows = hessian[missing]
            x[missing] = splu(rows[:, missing]).solve(-(rows @ x))
            nodes[:, :, column] = x.reshape(-1, 3) / scale.T


def _jerk(h: float) -> Array:
    """Return the form of the integral of the jerk squared in the numbers at the ends."""
    powers = _POWERS * np.array([1.0, h, h * h, 1.0, h, h * h])
    # jerk = 6 c_3 + 24 c_4 u + 60 c_5 u^2, over h^3; du = dt / h.
    jerk = powers[3:] * np.array([[6.0], [24.0], [60.0]])
    hilbert = np.array([[1.0, 1 / 2, 1 / 3], [1 / 2, 1 / 3, 1 / 4], [1 / 3, 1 / 4, 1 / 5]])
    return np.asarray(jerk.T @ hilbert @ jerk / h**5)
