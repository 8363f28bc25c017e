# SPDX-License-Identifier: Apache-2.0
"""The reference motion of a scene; those of the star, which the actuators follow, are here too."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_motions import (
    ActuatorMotion,
    follow_assembly,
    straight_path,
    sweep_path,
    through_points,
    through_samples,
)
from sst_ros.control.actuator_space import ActuatorSpaceMap
from sst_ros.control.reference import (
    PIECES,
    Reference,
    ReferenceMotion,
    equal_pieces,
    minimum_jerk_over,
)
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, Problem, SingularConfiguration
from sst_ros.mechanism.generic_math import axpy, multiply, quaternion_product
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.state import Quaternion, Vector3


def reference_motion(
    scene: Scene, read_motion: Callable[[str], Any] | None = None
) -> ReferenceMotion:
    """Return the reference motion of a scene.

    Args:
        scene: has a `motion`.
        read_motion: reads a bag as a `Trajectory`, as `recording.recording.read_run_motion` does.

    Raises:
        InputError: the scene has no motion, or one that cannot be made; see `through_points`.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion meets a parallel singularity.

    """
    motion = scene.motion
    if motion is None:
        raise InputError(scene.name, [Problem("motion", None, "the scene has no desired motion")])
    geometry = Geometry.of(scene)
    if motion.recorded:
        if read_motion is None:
            allowed = "a recorded motion cannot be read here"
            raise InputError(scene.name, [Problem("motion.recorded", motion.recorded.bag, allowed)])
        found = read_motion(motion.recorded.bag)
        x, y, z, w = found.quaternion[0].tolist()
        return through_samples(geometry, (x, y, z, w), found.t, found.gamma, found.gamma_dot)
    gamma = scene.initial.gamma
    x, y, z, w = initial_state(scene, geometry)[:4]
    start = (x, y, z, w)
    if motion.to_orientation:
        end = motion.to_orientation.orientation
        return GeodesicMotion(geometry, start, end, motion.to_orientation.duration)
    if spiral := motion.spiral:
        angles = (spiral.theta, spiral.phi, spiral.psi)
        return SpiralMotion(geometry, start, angles, spiral.duration)
    if points := motion.waypoints:
        rows = zip(
            *((at.time, at.gamma, at.gamma_dot, at.gamma_ddot) for at in points), strict=True
        )
        try:
            return through_points(geometry, start, *rows)
        except InputError as error:
            raise InputError(f"{scene.name}: motion.waypoints", error.problems) from None
    if motion.sweep:
        centre = motion.sweep.centre or gamma
        if centre != gamma:
            start = follow_assembly(geometry, start, gamma, centre)
        path, pieces = sweep_path(motion.sweep, centre)
    else:
        assert motion.to_angles is not None
        path = straight_path(gamma, motion.to_angles)
        pieces = equal_pieces(motion.to_angles.duration, 2 * PIECES)
    return ActuatorMotion(geometry, path, pieces, start)


StarState = tuple[Quaternion, Vector3, Vector3]


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
        self, geometry: Geometry, start: Quaternion, end: Quaternion, duration: float
    ) -> None:
        self._start = _unit(start)
        vector = (Rotation.from_quat(start).inv() * Rotation.from_quat(end)).as_rotvec()
        x, y, z = vector.tolist()
        self._angle = math.hypot(x, y, z)
        self._vector: Vector3 = (x, y, z)
        super().__init__(geometry, duration, self._angle)

    def star(self, time: float) -> StarState:
        """See `StarMotion.star`; the axis is the same in {B} and in {E}."""
        s, rate, acceleration = minimum_jerk_over(time, self.duration)
        half = 0.5 * s * self._angle
        part = math.sin(half) / self._angle if self._angle else 0.0
        q = quaternion_product(self._start, (*multiply(part, self._vector), math.cos(half)))
        return q, multiply(rate, self._vector), multiply(acceleration, self._vector)


class SpiralMotion(StarMotion):
    """R(0) Rz(theta) Ry(phi) Rz(psi - theta), the three angles [rad] grown by minimum jerk.

    Tilt, its direction and torsion: at phi = 0 the star only turns by psi about E, so the motion
    is smooth where ZYZ angles are not.
    """

    def __init__(
        self,
        geometry: Geometry,
        start: Quaternion,
        end: tuple[float, float, float],
        duration: float,
    ) -> None:
        self._start = _unit(start)
        self._theta, self._phi, self._psi = end
        turn = abs(self._theta) + abs(self._phi) + abs(self._psi)
        super().__init__(geometry, duration, turn)

    def star(self, time: float) -> StarState:
        """See `StarMotion.star`."""
        s, rate, acceleration = minimum_jerk_over(time, self.duration)
        a, b, c = s * self._theta, s * self._phi, s * (self._psi - self._theta)
        q = quaternion_product(
            quaternion_product(_about_z(a), (0.0, math.sin(0.5 * b), 0.0, math.cos(0.5 * b))),
            _about_z(c),
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
        return quaternion_product(self._start, q), multiply(rate, (x, y, z)), turning


def _about_z(angle: float) -> Quaternion:
    """Quaternion of a turn about z."""
    return (0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle))


def _unit(q: Quaternion) -> Quaternion:
    """Quaternion of length 1."""
    length = math.hypot(*q)
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
