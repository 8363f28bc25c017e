# SPDX-License-Identifier: Apache-2.0
"""Motions that are given as motions of the actuators; the star follows by direct kinematics."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from sst_ros.control.actuator_space import Coordinates
from sst_ros.control.reference import Desired, Quadruple, Triple
from sst_ros.control.rest_to_rest import PlannedMotion
from sst_ros.errors import InputError, Problem, SingularConfiguration
from sst_ros.mechanism import continuation
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Geometry

Path = Callable[[float], tuple[Triple, Triple, Triple]]
"""Time [s] to gamma [rad], gamma_dot [rad/s], gamma_ddot [rad/s^2]."""

STEP = 0.03
"""Distance in gamma [rad] between orientations that are kept."""

LONGEST = 100.0
"""No motion goes further in gamma [rad] from one of its points to the next."""

_SAMPLES = 16


class ActuatorMotion(PlannedMotion):
    """A path of the actuators and the assembly that is carried along.

    Orientations are followed once, by `continuation`, in steps that cannot leave the assembly, and
    kept; any other one is found from the nearest of these. So `at` does not depend on what was
    asked before.

    Args:
        geometry: base triangle and star.
        path: what the actuators do between 0 and the duration.
        pieces: see `PlannedMotion`.
        start: quaternion (x, y, z, w) of {E} in {B} at time 0.

    Raises:
        SingularConfiguration: a parallel singularity lies in the way; the error says when.
        InputError: the path goes too far to be followed.
        AssemblyError: start is no orientation that the path begins with.

    """

    def __init__(
        self, geometry: Geometry, path: Path, pieces: tuple[float, ...], start: Quadruple
    ) -> None:
        super().__init__(pieces[-1], pieces)
        self._path, self._geometry = path, geometry
        self._coordinates = Coordinates(geometry)
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

    def _inside(self, time: float) -> Desired:
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
            raise InputError("motion", [Problem("way of gamma", length, allowed)])
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
