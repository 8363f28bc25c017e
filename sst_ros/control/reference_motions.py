# SPDX-License-Identifier: Apache-2.0
"""The reference motion of a scene."""

from __future__ import annotations

from collections.abc import Callable

from sst_ros.control.actuator_motions import ActuatorMotion, straight_path, sweep_path
from sst_ros.control.reference import Quadruple, ReferenceMotion, equal_pieces
from sst_ros.control.star_motions import PIECES, GeodesicMotion, SpiralMotion
from sst_ros.control.waypoints import MotionSamples, moved, recorded, waypoints
from sst_ros.dynamics.initial_state import initial_state
from sst_ros.errors import InputError, Problem
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene

__all__ = ["MotionSamples", "ReferenceMotion", "recorded", "reference_motion", "waypoints"]


def reference_motion(
    scene: Scene, samples: Callable[[str], MotionSamples] | None = None
) -> ReferenceMotion:
    """Return the reference motion of a scene.

    Args:
        scene: has a `motion`.
        samples: reads a bag by its path, as `report.recorded_motion.samples` does.

    Raises:
        InputError: the scene has no motion, or one that cannot be made; see `waypoints`.
        AssemblyError: the initial gamma has no unique admissible assembly.
        SingularConfiguration: the motion meets a parallel singularity.

    """
    motion = scene.motion
    if motion is None:
        raise InputError(scene.name, [Problem("motion", None, "the scene has no desired motion")])
    geometry = Geometry.of(scene)
    if motion.recorded:
        if samples is None:
            allowed = "a recorded motion cannot be read here"
            raise InputError(scene.name, [Problem("motion.recorded", motion.recorded.bag, allowed)])
        return recorded(geometry, samples(motion.recorded.bag))
    gamma = scene.initial.gamma
    x, y, z, w = initial_state(scene, geometry)[:4]
    start = (x, y, z, w)
    if motion.to_orientation:
        end = motion.to_orientation.orientation
        return GeodesicMotion(geometry, start, end, motion.to_orientation.duration)
    if spiral := motion.spiral:
        angles = (spiral.theta, spiral.phi, spiral.psi)
        return SpiralMotion(geometry, start, angles, spiral.duration)
    if motion.waypoints:
        return _through(scene, geometry, start)
    if motion.sweep:
        centre = motion.sweep.centre or gamma
        if centre != gamma:
            start = moved(geometry, start, gamma, centre)
        path, pieces = sweep_path(motion.sweep, centre)
    else:
        assert motion.to_angles is not None
        path = straight_path(gamma, motion.to_angles)
        pieces = equal_pieces(motion.to_angles.duration, 2 * PIECES)
    return ActuatorMotion(geometry, path, pieces, start)


def _through(scene: Scene, geometry: Geometry, start: Quadruple) -> ReferenceMotion:
    assert scene.motion is not None
    points = scene.motion.waypoints
    try:
        return waypoints(
            geometry,
            start,
            [point.time for point in points],
            [point.gamma for point in points],
            [point.gamma_dot for point in points],
            [point.gamma_ddot for point in points],
        )
    except InputError as error:
        raise InputError(f"{scene.name}: motion.waypoints", error.problems) from None
