# SPDX-License-Identifier: Apache-2.0
"""Reference motions through points in time: waypoints, and the samples of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sst_ros.control.actuator_motions import ActuatorMotion
from sst_ros.control.quintic import Quintic
from sst_ros.control.reference import REST, Quadruple, ReferenceMotion, Triple
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism import continuation, kinematics
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry

Points = Sequence[Sequence[float]]
OpenPoints = Sequence[Sequence[float] | None]

NEAR = 0.1
"""Largest distance of a first point at time 0 from the start [rad]."""


SAMPLES_A_PIECE = 8


@dataclass(frozen=True)
class MotionSamples:
    """A recorded motion.

    Attributes:
        times: of the samples, rising [s], shape (n,); the motion begins with the first.
        gamma, gamma_dot: of the actuators [rad], [rad/s], shape (n, 3).
        quaternion: of {E} in {B} at the first sample, (x, y, z, w).

    """

    times: Array
    gamma: Array
    gamma_dot: Array
    quaternion: Quadruple


def waypoints(
    geometry: Geometry,
    start: Quadruple,
    times: Sequence[float],
    positions: Points,
    velocities: OpenPoints | None = None,
    accelerations: OpenPoints | None = None,
    begin: tuple[Triple, Triple] = (REST, REST),
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
    begun = moved(geometry, start, here, gamma[0])
    return _along(geometry, begun, Quintic(at, gamma, rates, seconds), tuple(at.tolist()))


def recorded(geometry: Geometry, samples: MotionSamples) -> ReferenceMotion:
    """Return the motion of a recording, quintic between samples; it may begin and end moving.

    Raises:
        AssemblyError: the recording is of another manipulator.
        SingularConfiguration: the motion meets a parallel singularity.

    """
    times = samples.times - samples.times[0]
    gamma = np.unwrap(samples.gamma, axis=0)
    free = np.full_like(gamma, np.nan)
    # Samples lie much denser than the motion turns: several make one piece.
    pieces = (*times[:-1:SAMPLES_A_PIECE].tolist(), float(times[-1]))
    spline = Quintic(times, gamma, samples.gamma_dot, free)
    return _along(geometry, samples.quaternion, spline, pieces)


def moved(geometry: Geometry, start: Quadruple, here: ArrayLike, there: ArrayLike) -> Quadruple:
    """Follow the assembly from one gamma straight to another."""
    rotation = continuation.advance(geometry, rotation_matrix(start), here, there)
    x, y, z, w = quaternion_of(rotation).tolist()
    return (x, y, z, w)


def _along(
    geometry: Geometry, start: Quadruple, spline: Quintic, pieces: tuple[float, ...]
) -> ReferenceMotion:
    def path(time: float) -> tuple[Triple, Triple, Triple]:
        (p1, p2, p3), (v1, v2, v3), (a1, a2, a3) = spline.at(time)
        return (p1, p2, p3), (v1, v2, v3), (a1, a2, a3)

    return ActuatorMotion(geometry, path, pieces, start)


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
