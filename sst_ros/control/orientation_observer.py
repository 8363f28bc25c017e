# SPDX-License-Identifier: Apache-2.0
"""Orientation observer: the orientation that follows from encoder angles, by continuity.

Its steps are those that `continuation` proves to stay in the assembly mode. The proof needs sigma,
the least singular value of J2. The rows of J2 are unit vectors, so its squared singular values sum
to 3, the product of the larger two is at most 3/2, and sigma >= 2/3 abs(det J2): enough for most
steps, and cheap. Where a step is too long for that, `continuation` divides it.
"""

from __future__ import annotations

import math

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.reference import Quadruple, Triple
from sst_ros.mechanism import continuation
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.generic_math import axpy, cross, dot, rotation_rows
from sst_ros.mechanism.geometry import Geometry

CLOSED = 1e-14
"""Largest loop-closure residual abs(r_k . t_k) of an orientation that is returned."""


class OrientationObserver:
    """Tracks one assembly mode, however far apart successive angles are.

    Args:
        geometry: base triangle and star.
        quaternion: initial orientation (x, y, z, w).
        gamma: actuator angles there [rad].

    """

    def __init__(self, geometry: Geometry, quaternion: Quadruple, gamma: Triple) -> None:
        self.coordinates = ActuatorSpaceMap(geometry)
        self._begin = quaternion, gamma
        across = np.cross(geometry.w, geometry.v)
        legs = (geometry.v.tolist(), across.tolist(), geometry.e.tolist())
        self._legs = list(zip(*legs, strict=True))
        self.reset()

    def reset(self) -> None:
        """Return to the initial orientation."""
        self._quaternion, self._gamma = self._begin
        self._sigma, _ = self._measures(self._quaternion, self._gamma)

    def update(self, gamma: Triple) -> Quadruple:
        """Return the quaternion (x, y, z, w) at the next angles [rad].

        Raises:
            BranchEnds: a parallel singularity lies between, or no assembly has these angles.

        """
        found = self._stepped(gamma)
        if found is None:
            found = self._followed(gamma)
        self._quaternion, self._gamma = found, gamma
        return found

    def _stepped(self, gamma: Triple) -> Quadruple | None:
        """Newton's method in one step; None where it might reach another assembly mode."""
        step, sigma = math.dist(gamma, self._gamma), self._sigma
        if step > continuation.SAFE * sigma * sigma:
            return None
        try:
            found = self.coordinates.orientation(self._quaternion, gamma)
        except ArithmeticError:
            return None
        # The theorem holds in a ball about R; chords of rotations are 2 sqrt(2) sin(angle / 2).
        half = math.sqrt(max(0.0, 1.0 - sum(map(float.__mul__, found, self._quaternion)) ** 2))
        next_sigma, residual = self._measures(found, gamma)
        if residual > CLOSED or half > 0.25 * (sigma - step):
            return None
        self._sigma = next_sigma
        return found

    def _followed(self, gamma: Triple) -> Quadruple:
        rotation = continuation.advance(
            self.coordinates.geometry, rotation_matrix(self._quaternion), self._gamma, gamma
        )
        x, y, z, w = quaternion_of(rotation).tolist()
        self._sigma, _ = self._measures((x, y, z, w), gamma)
        return x, y, z, w

    def _measures(self, quaternion: Quadruple, gamma: Triple) -> tuple[float, float]:
        """Return a lower bound of sigma, and the largest residual abs(r_k . t_k)."""
        rows = rotation_rows(quaternion)
        normals, worst = [], 0.0
        for angle, (v, across, e) in zip(gamma, self._legs, strict=True):
            r = axpy(math.cos(angle), v, math.sin(angle), across)
            t = dot(rows[0], e), dot(rows[1], e), dot(rows[2], e)
            normals.append(cross(t, r))
            worst = max(worst, abs(dot(r, t)))
        determinant = dot(normals[0], cross(normals[1], normals[2]))
        return 2.0 / 3.0 * abs(determinant), worst
