# SPDX-License-Identifier: Apache-2.0
"""Reference motions of the star; the actuators follow by inverse kinematics."""

from __future__ import annotations

import math
from abc import abstractmethod

from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.quaternions import about_z, product, unit
from sst_ros.control.quintic import timed
from sst_ros.control.reference import Quadruple, Reference, ReferenceMotion, Triple, equal_pieces
from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism.generic_math import axpy, scaled
from sst_ros.mechanism.geometry import Geometry

PIECES = 8
"""Pieces of a minimum-jerk law, and of a quarter of a turn."""

StarState = tuple[Quadruple, Triple, Triple]


class StarMotion(ReferenceMotion):
    """A motion of the star; a subclass defines it by `star`."""

    def __init__(self, geometry: Geometry, duration: float, turn: float) -> None:
        """Prepare a motion that turns the star by some `turn` [rad] in all."""
        count = PIECES + math.ceil(turn / (0.5 * math.pi)) * PIECES
        super().__init__(duration, equal_pieces(duration, count))
        self._coordinates = ActuatorSpaceMap(geometry)

    @abstractmethod
    def star(self, time: float) -> StarState:
        """Quaternion, W and W_dot at a time [s] between 0 and the duration."""

    def _inside(self, time: float) -> Reference:
        try:
            return self._coordinates.of_star(*self.star(time))
        except ArithmeticError:
            said = f"serial singularity at t = {time:.9g} s, sin(mu)"
            raise SingularConfiguration(said, 0.0) from None


class GeodesicMotion(StarMotion):
    """From one orientation to another about one axis (the geodesic of SO(3)), minimum jerk.

    Quaternions (x, y, z, w) may have any length > 0; the shorter rotation is taken.
    """

    def __init__(
        self, geometry: Geometry, start: Quadruple, end: Quadruple, duration: float
    ) -> None:
        self._start = unit(start)
        vector = (Rotation.from_quat(start).inv() * Rotation.from_quat(end)).as_rotvec()
        x, y, z = vector.tolist()
        self._angle = math.hypot(x, y, z)
        self._vector: Triple = (x, y, z)
        super().__init__(geometry, duration, self._angle)

    def star(self, time: float) -> StarState:
        """See `StarMotion.star`; the axis is the same in {B} and in {E}."""
        s, rate, acceleration = timed(time, self.duration)
        half = 0.5 * s * self._angle
        part = math.sin(half) / self._angle if self._angle else 0.0
        q = product(self._start, (*scaled(part, self._vector), math.cos(half)))
        return q, scaled(rate, self._vector), scaled(acceleration, self._vector)


class SpiralMotion(StarMotion):
    """R(0) Rz(theta) Ry(phi) Rz(psi - theta), the three angles [rad] grown by minimum jerk.

    Tilt, its direction and torsion: at phi = 0 the star only turns by psi about E, so the motion
    is smooth where ZYZ angles are not.
    """

    def __init__(
        self,
        geometry: Geometry,
        start: Quadruple,
        end: tuple[float, float, float],
        duration: float,
    ) -> None:
        self._start = unit(start)
        self._theta, self._phi, self._psi = end
        turn = abs(self._theta) + abs(self._phi) + abs(self._psi)
        super().__init__(geometry, duration, turn)

    def star(self, time: float) -> StarState:
        """See `StarMotion.star`."""
        s, rate, acceleration = timed(time, self.duration)
        a, b, c = s * self._theta, s * self._phi, s * (self._psi - self._theta)
        q = product(
            product(about_z(a), (0.0, math.sin(0.5 * b), 0.0, math.cos(0.5 * b))), about_z(c)
        )
        # W = u rate with u = (theta part, phi part, third angle's part) by the angles a, b, c.
        third = self._psi - self._theta
        sb, cb, sc, cc = math.sin(b), math.cos(b), math.sin(c), math.cos(c)
        x = -self._theta * sb * cc + self._phi * sc
        y = self._theta * sb * sc + self._phi * cc
        z = self._theta * cb + third
        # Its derivatives by s; the angles are linear in s.
        dx = -self._theta * (self._phi * cb * cc - third * sb * sc) + self._phi * third * cc
        dy = self._theta * (self._phi * cb * sc + third * sb * cc) - self._phi * third * sc
        dz = -self._theta * self._phi * sb
        turning = axpy(acceleration, (x, y, z), rate * rate, (dx, dy, dz))
        return product(self._start, q), scaled(rate, (x, y, z)), turning
