# SPDX-License-Identifier: Apache-2.0
"""The state in which a scene begins."""

from __future__ import annotations

import numpy as np

from sst_ros.errors import SingularConfiguration
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.frames import quaternion_of, rotation_matrix
from sst_ros.mechanism.geometry import Array, Geometry
from sst_ros.scene.scene import Scene

SINGULAR = 1.5e-5
"""det J2 below which rounding, over its square, leaves a rate of gamma less than six digits."""


def initial_state(scene: Scene, geometry: Geometry) -> tuple[float, ...]:
    """Quaternion (x, y, z, w) and body rate [rad/s] at t = 0, seven numbers.

    Raises:
        AssemblyError: the initial gamma has no admissible assembly, or several and the scene
            selects none.
        SingularConfiguration: gamma_dot does not determine the body rate there.

    """
    initial, gamma = scene.initial, np.array(scene.initial.gamma)
    meant = None if initial.orientation is None else rotation_matrix(initial.orientation)
    assembly = kinematics.admissible(geometry, gamma, meant)
    rate = body_rate(geometry, gamma, np.array(initial.gamma_dot), assembly.rotation)
    return (*quaternion_of(assembly.rotation).tolist(), *rate.tolist())


def body_rate(geometry: Geometry, gamma: Array, gamma_dot: Array, rotation: Array) -> Array:
    """Body rate [rad/s] of a posture; rest needs no Jacobian, which a singular one has not.

    Raises:
        SingularConfiguration: gamma_dot does not determine it.

    """
    if not gamma_dot.any():
        return np.zeros(3)
    at = virtual_work.posture(geometry, gamma, rotation)
    determinant = float(np.linalg.det(at.j2))
    if abs(determinant) < SINGULAR:
        message = "gamma_dot does not determine the body rate: parallel singularity, det J2"
        raise SingularConfiguration(message, determinant)
    return np.asarray(rotation.T @ at.j @ gamma_dot)
