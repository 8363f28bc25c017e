# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics, and controllers that track a reference motion by them.

The control laws are in `law`: by the model, by feedback, or by both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap, Reference, ReferenceMotion
from sst_ros.control.law import (
    Command,
    ControlLaw,
    ControllerSettings,
    command_limit,
    feedback_gains,
)
from sst_ros.dynamics.traced_dynamics import Dynamics
from sst_ros.errors import SingularConfiguration, SstError, refuse_unless
from sst_ros.mechanism import kinematics, virtual_work
from sst_ros.mechanism.generic_math import triple
from sst_ros.mechanism.geometry import Geometry, quaternion_of, rotation_matrix
from sst_ros.scene.scene import Scene
from sst_ros.state import ZERO, Quaternion, State, Vector3

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


class ControlStopped(SstError):
    """No torque can be computed; every later call raises the same until a reset.

    Attributes:
        time: of the motion [s].

    """

    def __init__(self, reason: str, time: float) -> None:
        self.time = time
        super().__init__(f"control stopped at t = {time:.9f} s: {reason}")


class Measurement(NamedTuple):
    """Angles [rad] and rates [rad/s] of the actuators, as encoders measure them."""

    gamma: Vector3
    gamma_dot: Vector3


class Controller:
    """A controller that tracks one reference motion by one of the five schemes of the law.

    Args:
        model: the manipulator as the controller models it; the plant may differ.
        motion: the reference motion.
        settings: scheme (`mode`) and gains.
        period_s: control period, over which a command is held [s].

    Attributes:
        inertia: M_kk at the start of the motion [kg m^2], by which gains are made.

    Raises:
        InputError: the integral action would be unstable.
        SingularConfiguration: the motion begins in a singularity.

    """

    def __init__(
        self, model: Scene, motion: ReferenceMotion, settings: ControllerSettings, period_s: float
    ) -> None:
        self._motion, self._settings, self._period_s = motion, settings, period_s
        geometry, start = Geometry.of(model), motion.at(0.0)
        self._inverse, self._space = InverseDynamics(model), ActuatorSpaceMap(geometry)
        self._begin = start.quaternion, start.gamma
        rotation = rotation_matrix(start.quaternion)
        posture = virtual_work.posture(geometry, np.array(start.gamma), rotation)
        mechanism = virtual_work.Mechanism.of(model)
        t1, _ = virtual_work.equation_of_motion(mechanism, posture, (0.0, 0.0, 0.0))
        self.inertia: Vector3 = triple((-np.diag(t1)).tolist())
        column, rate = np.array(self.inertia)[:, None], settings.integral_rate
        gains = feedback_gains(column, lambda name: getattr(settings, name), settings.direct)
        kp, kd = (triple(gain[:, 0].tolist()) for gain in gains)
        # Routh: s^3 + kd s^2 + kp s + kp r is stable for 0 < r < kd.
        allowed = f"must be < {min(kd):g} 1/s, damping over inertia: else the loop is unstable"
        refuse_unless("control", ("integral_rate", rate, not rate or rate < min(kd), allowed))
        limit = float(command_limit(settings.torque_limit, model))
        known = limit if math.isfinite(limit) else None
        functions, numbers = (self._inverse.torque, self._space.star_motion), (kp, kd, self.inertia)
        self._law = ControlLaw(settings, *functions, *numbers, rate, known, period_s)
        self.reset()

    def reset(self) -> None:
        """Clear the integral, the orientation that was observed last, and a failure."""
        self._known, self._integral = self._begin, ZERO
        self._failure: ControlStopped | None = None

    def follow(self, motion: ReferenceMotion) -> None:
        """Track another motion, from the present reference on; gains and integral stay."""
        self._motion = motion

    def desire(self, time: float) -> tuple[Reference, Vector3, Vector3]:
        """Return the reference at a time [s], its torques [N m], and those that a period holds.

        The torques are zeros where the mode does not feed them forward.
        """
        desired = self._motion.at(time)
        if not self._settings.feeds:
            return desired, ZERO, ZERO
        now = held = self._inverse.reference_torque(desired)
        if self._settings.feedforward_at == "middle":
            held = self._inverse.reference_torque(self._motion.at(time + 0.5 * self._period_s))
        return desired, now, held

    def command(self, time: float, measured: Measurement) -> Command:
        """Return the command at a time of the motion [s], to be held for a period.

        Raises:
            ControlStopped: the measurement is not finite, the assembly mode ends, or the model is
                singular there.

        """
        if self._failure is not None:
            raise self._failure
        allowed, observes = "must be finite numbers", self._settings.observes
        try:
            given = (*measured.gamma, *measured.gamma_dot)
            refuse_unless("control", ("measured", given, all(map(math.isfinite, given)), allowed))
            desired, *torques = self.desire(time)
            observed: Any = self._space.follow(*self._known, measured.gamma) if observes else ()
            command = self._law.answer(desired, torques, *measured, observed, self._integral)
            total = command.total
            refuse_unless("control", ("torque", total, all(map(math.isfinite, total)), allowed))
        except (SstError, ArithmeticError, ValueError) as error:
            self._failure = ControlStopped(str(error), time)
            raise self._failure from error
        self._integral = command.integral
        if observes:
            self._known = observed, measured.gamma
        return command

    def __call__(self, time: float, state: State) -> Vector3:
        """Torques [N m] for the angles and rates of a state: a function for `simulate`."""
        joints = state.joints
        return self.command(time, Measurement(joints.gamma, joints.gamma_dot)).torque
