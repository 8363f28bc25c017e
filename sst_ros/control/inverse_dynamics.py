# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics: the torques that make the manipulator accelerate as it should."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sst_ros.control.actuator_space import Reference
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import SingularConfiguration, refuse_unless
from sst_ros.mechanism import kinematics
from sst_ros.mechanism.generic_math import ZERO
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene
from sst_ros.state import Quaternion, State, Vector3

SINGULAR = 1e-10  # sin(mu_k) and det J2 below which rounding leaves a torque less than six digits


class InverseDynamics:
    """Torques at the joints of a scene, all its terms included.

    It is the model that the simulation integrates, solved for the torques: tau = M gamma_ddot + h
    (the paper's Eq. 90 with every term of the scene). What lies between a command and a torque
    (limit, lag) is no part of it.

    Args:
        scene: the manipulator.

    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        dynamics = Dynamics.of(scene)
        self._has_moment_topic, self._program = dynamics.has_moment_topic, dynamics.inverse

    def torque(
        self,
        quaternion: Quaternion,
        body_rate: Vector3,
        body_acceleration: Vector3,
        moment: Vector3 = ZERO,
    ) -> Vector3:
        """Torques [N m] that give W_dot in a state.

        Args:
            quaternion: of {E} in {B}, (x, y, z, w), of any length > 0.
            body_rate: W in {E} [rad/s].
            body_acceleration: W_dot in {E} [rad/s^2].
            moment: external moment on the star in {B} [N m], used where a topic gives it.

        Raises:
            SingularConfiguration: serial (sin(mu_k) = 0) or parallel (det J2 = 0); no torques
                control the star there.
            InputError: an argument is not finite, or the quaternion has no direction.

        """
        acting = moment if self._has_moment_topic else ()
        given = (*quaternion, *body_rate, *body_acceleration, *acting)
        try:
            first, second, third, determinant, *squares = self._program(*given)
            det_j2 = abs(determinant) * math.sqrt(squares[0] * squares[1] * squares[2])
        except (ArithmeticError, ValueError):
            raise self._refusal(quaternion, given) from None
        # Comparisons with NaN are false: what is not finite is refused, too.
        sound = math.isfinite(first + second + third) and det_j2 > SINGULAR
        if not (sound and min(squares) > SINGULAR * SINGULAR):
            raise self._refusal(quaternion, given)
        return first, second, third

    def reference_torque(self, reference: Reference) -> Vector3:
        """Torques [N m] of a reference: the feedforward; raises as `torque`."""
        return self.torque(reference.quaternion, reference.body_rate, reference.body_acceleration)

    def gravity_torque(self, at: State | Sequence[float]) -> Vector3:
        """Torques [N m] that hold the manipulator at rest against gravity, springs and the like.

        Args:
            at: a state of a simulation; or gamma [rad], shape (3,), for the admissible assembly;
                or the quaternion (x, y, z, w) of {E} in {B}, shape (4,).

        Raises:
            SingularConfiguration, InputError: as `torque`.
            AssemblyError: gamma has no unique admissible assembly.

        """
        pose = at.quaternion if isinstance(at, State) else tuple(at)
        if len(pose) == 3:
            rotation = kinematics.admissible(Geometry.of(self.scene), pose).rotation
            pose = tuple(quaternion_of(rotation).tolist())
        allowed = "must be a State, three angles gamma or a quaternion"
        refuse_unless("gravity_torque", ("at", at, len(pose) == 4, allowed))
        x, y, z, w = pose
        return self.torque((x, y, z, w), ZERO, ZERO)

    def _refusal(self, quaternion: Quaternion, given: Sequence[float]) -> SingularConfiguration:
        """Return why there is no torque; raises InputError where numbers are wrong."""
        finite = all(map(math.isfinite, given))
        short = finite and math.hypot(*quaternion) < 1e-100
        refuse_unless(
            "inverse dynamics",
            ("state", tuple(given), finite, "must be finite numbers"),
            ("quaternion", quaternion, not short, "must have a length > 0"),
        )
        geometry = Geometry.of(self.scene)
        # t_k x w_k is r_k times sin(mu_k); J2 has the rows t_k x r_k.
        t = geometry.e @ rotation_matrix(quaternion).T
        across = np.cross(t, geometry.w)
        sines = np.linalg.norm(across, axis=1)
        if (least := float(sines.min())) <= SINGULAR:
            return SingularConfiguration("serial singularity, sin(mu)", least)
        determinant = float(np.linalg.det(np.cross(t, across / sines[:, None])))
        if abs(determinant) <= 2.0 * SINGULAR:
            return SingularConfiguration("parallel singularity, det J2", determinant)
        said = "no finite torque gives this acceleration: det J2"
        return SingularConfiguration(said, determinant)
