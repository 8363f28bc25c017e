# SPDX-License-Identifier: Apache-2.0
"""Reference motions of the actuators: point to point, and sine sweeps; the star follows."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.quintic import minimum_jerk, timed
from sst_ros.control.reference import Quadruple, Reference, ReferenceMotion, Triple, equal_pieces
from sst_ros.control.star_motions import PIECES
from sst_ros.errors import InputError, Problem, SingularConfiguration
from sst_ros.mechanism import continuation
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import axpy, scaled
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.motions import Sweep, ToAngles

Path = Callable[[float], tuple[Triple, Triple, Triple]]
"""Time [s] to gamma [rad], gamma_dot [rad/s], gamma_ddot [rad/s^2]."""

STEP = 0.03
"""Distance in gamma [rad] between orientations that are kept."""

LONGEST = 100.0
"""Longest path in gamma [rad] within a piece of a motion."""

_SAMPLES = 16


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
        self, geometry: Geometry, path: Path, pieces: tuple[float, ...], start: Quadruple
    ) -> None:
        super().__init__(pieces[-1], pieces)
        self._path, self._geometry = path, geometry
        self._coordinates = ActuatorSpaceMap(geometry)
        self._times = list(_spaced(path, pieces))
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


def _spaced(path: Path, pieces: tuple[float, ...]) -> Iterator[float]:
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


def _alike(quaternions: list[list[float]], before: Quadruple) -> Iterator[Quadruple]:
    """Yield quaternions with signs that change as little as they can."""
    for x, y, z, w in quaternions:
        same = x * before[0] + y * before[1] + z * before[2] + w * before[3] >= 0.0
        before = (x, y, z, w) if same else (-x, -y, -z, -w)
        yield before


def straight_path(start: Triple, goal: ToAngles) -> Path:
    """From one gamma straight to another, with minimum jerk."""
    span = axpy(1.0, goal.gamma, -1.0, start)

    def path(time: float) -> tuple[Triple, Triple, Triple]:
        s, rate, acceleration = timed(time, goal.duration)
        return axpy(1.0, start, s, span), scaled(rate, span), scaled(acceleration, span)

    return path


def sweep_path(sweep: Sweep, centre: Triple) -> tuple[Path, tuple[float, ...]]:
    """Sines that fade in and out, and pieces of a quarter of a period or less."""
    last = sweep.last_frequency or sweep.frequency
    slopes = [(b - a) / sweep.duration for a, b in zip(sweep.frequency, last, strict=True)]
    rows = list(zip(centre, sweep.amplitude, sweep.frequency, slopes, strict=True))

    def path(time: float) -> tuple[Triple, Triple, Triple]:
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
        return (p[0], p[1], p[2]), (v[0], v[1], v[2]), (a[0], a[1], a[2])

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
