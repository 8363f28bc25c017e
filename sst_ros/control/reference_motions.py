# SPDX-License-Identifier: Apache-2.0
"""The reference motion of a scene; those of the star, which the actuators follow, are here too."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from scipy.spatial.transform import Rotation

from sst_ros.control.actuator_motions import (
    ActuatorMotion,
    straight_path,
    sweep_path,
    through_points,
    through_samples,
)
from sst_ros.control.actuator_space import ActuatorSpaceMap, follow_assembly
from sst_ros.control.reference import (
    PIECES,
    Reference,
    ReferenceMotion,
    equal_pieces,
    minimum_jerk_over,
)
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, Problem, SingularConfiguration
from sst_ros.mechanism.generic_math import axpy, multiply, quaternion_product, triple
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.loads import Spiral
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
    if turn := motion.to_orientation:
        return geodesic_motion(geometry, start, turn.orientation, turn.duration)
    if motion.spiral:
        return spiral_motion(geometry, start, motion.spiral)
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
    """A motion of the star.

    Args:
        geometry: base triangle and star.
        star: quaternion, W and W_dot at a time [s] between 0 and the duration.
        duration: [s].
        turn: by which the star turns in all [rad].

    """

    def __init__(
        self, geometry: Geometry, star: Callable[[float], StarState], duration: float, turn: float
    ) -> None:
        count = PIECES + math.ceil(turn / (0.5 * math.pi)) * PIECES
        super().__init__(duration, equal_pieces(duration, count))
        self._star, self._coordinates = star, ActuatorSpaceMap(geometry)

    def _inside(self, time: float) -> Reference:
        try:
            return self._coordinates.of_star(*self._star(time))
        except ArithmeticError:
            said = f"serial singularity at t = {time:.9g} s, sin(mu)"
            raise SingularConfiguration(said, 0.0) from None


def geodesic_motion(
    geometry: Geometry, start: Quaternion, end: Quaternion, duration: float
) -> StarMotion:
    """From one orientation to another about one axis (the geodesic of SO(3)), minimum jerk.

    Quaternions (x, y, z, w) may have any length > 0; the shorter rotation is taken.
    """
    # The axis is the same in {B} and in {E}.
    turn = (Rotation.from_quat(start).inv() * Rotation.from_quat(end)).as_rotvec()
    vector, begin = triple(turn.tolist()), _unit(start)
    angle = math.hypot(*vector)

    def star(time: float) -> StarState:
        s, rate, acceleration = minimum_jerk_over(time, duration)
        half = 0.5 * s * angle
        part = math.sin(half) / angle if angle else 0.0
        q = quaternion_product(begin, (*multiply(part, vector), math.cos(half)))
        return q, multiply(rate, vector), multiply(acceleration, vector)

    return StarMotion(geometry, star, duration, angle)


def spiral_motion(geometry: Geometry, start: Quaternion, spiral: Spiral) -> StarMotion:
    """R(0) Rz(theta) Ry(phi) Rz(psi - theta), the three angles [rad] grown by minimum jerk.

    Tilt, its direction and torsion: at phi = 0 the star only turns by psi about E, so the motion
    is smooth where ZYZ angles are not.
    """
    begin, duration = _unit(start), spiral.duration
    theta, phi, third = spiral.theta, spiral.phi, spiral.psi - spiral.theta

    def star(time: float) -> StarState:
        s, rate, acceleration = minimum_jerk_over(time, duration)
        a, b, c = s * theta, s * phi, s * third
        q = quaternion_product(
            quaternion_product(_about_z(a), (0.0, math.sin(0.5 * b), 0.0, math.cos(0.5 * b))),
            _about_z(c),
        )
        # W = u rate with u = (theta part, phi part, third angle's part) by the angles a, b, c.
        sb, cb, sc, cc = math.sin(b), math.cos(b), math.sin(c), math.cos(c)
        u = (-theta * sb * cc + phi * sc, theta * sb * sc + phi * cc, theta * cb + third)
        # Its derivatives by s; the angles are linear in s.
        slope = (
            -theta * (phi * cb * cc - third * sb * sc) + phi * third * cc,
            theta * (phi * cb * sc + third * sb * cc) - phi * third * sc,
            -theta * phi * sb,
        )
        turning = axpy(acceleration, u, rate * rate, slope)
        return quaternion_product(begin, q), multiply(rate, u), turning

    turn = abs(theta) + abs(phi) + abs(spiral.psi)
    return StarMotion(geometry, star, duration, turn)


def _about_z(angle: float) -> Quaternion:
    """Quaternion of a turn about z."""
    return (0.0, 0.0, math.sin(0.5 * angle), math.cos(0.5 * angle))


def _unit(q: Quaternion) -> Quaternion:
    """Quaternion of length 1."""
    length = math.hypot(*q)
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
