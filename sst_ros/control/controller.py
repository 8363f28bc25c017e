# SPDX-License-Identifier: Apache-2.0
"""Controllers that track a reference motion: by the model, by feedback, or by both.

The five schemes, with e = desired - measured in gamma:

    feedforward         tau = ID(desired)
    pd                  tau = K e + D e_dot
    gravity_pd          tau = K e + D e_dot + G(measured)           Takegaki and Arimoto 1981
    feedforward_pd      tau = ID(desired) + K e + D e_dot
    computed_torque     tau = ID(measured state, gamma_ddot + kd e_dot + kp e)

ID is the inverse dynamics (Eq. 90) with all terms of the model, G its gravity torque.

On SO(3) the error of computed_torque is the rotation vector phi = log(R^T R_d) in {E}, and W_dot =
d/dt(R^T R_d W_d) + kd e_W + kp phi with e_W = R^T R_d W_d - W. As phi is an eigenvector of its own
differential, kp phi^2 + e_W^2 falls at the rate 2 kd e_W^2 from every error below half a turn
(Bullo and Murray 1995).

Integral action adds K r times the integral of e. It is frozen while a torque is at its limit and
the error would drive it further (conditional integration, Astrom and Hagglund 2006, section 3.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sst_ros.control.actuator_space import OrientationObserver
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.reference import Reference, ReferenceMotion
from sst_ros.errors import InputError, Problem, SstError
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.frames import rotation_matrix
from sst_ros.mechanism.generic_math import (
    ZERO,
    add,
    axpy,
    cross,
    dot,
    multiply,
    relative_quaternion,
    rotation_rows,
)
from sst_ros.mechanism.geometry import Geometry
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Section, choice, number
from sst_ros.state import Quaternion, State, Vector3, clamp

__all__ = ["MODES", "Command", "ControlStopped", "Controller", "Measurement"]

MODES = ("feedforward", "feedforward_pd", "computed_torque", "pd", "gravity_pd")

SPACES = ("gamma", "so3")

INSTANTS = ("start", "middle")


@dataclass(frozen=True)
class ControllerSettings(Section):
    """Mode and gains.

    Gains are of a joint, tau_k = stiffness_k e_k + damping_k e_dot_k with e = desired - measured.
    By bandwidth they are those of the inertia M_kk that joint k has at the start of the motion:
    stiffness M_kk bandwidth^2, damping 2 damping_ratio M_kk bandwidth; so pd, gravity_pd and
    feedforward_pd have equal gains. computed_torque takes them over M_kk, as accelerations.
    """

    mode: str = choice(
        "feedforward: torque of the desired motion; feedforward_pd: and feedback; computed_torque: "
        "the model at the measured state, and feedback; pd: feedback alone; gravity_pd: and the "
        "weight at the measured position",
        MODES,
        default="feedforward",
    )
    space: str = choice(
        "where computed_torque is linear: the actuator angles, or the orientation",
        SPACES,
        default="gamma",
    )
    bandwidth: float = number(
        "natural frequency of the error", "rad/s", default=30.0, above=0.0, most=1e6
    )
    damping_ratio: float = number(
        "damping ratio of the error", "1", default=1.0, above=0.0, most=1e3
    )
    stiffness: Vector3 = number(
        "stiffness of the feedback, in place of bandwidth; zeros for that of bandwidth",
        "N m/rad",
        shape=(3,),
        default=(0.0, 0.0, 0.0),
        least=0.0,
        most=1e9,
    )
    damping: Vector3 = number(
        "damping of the feedback, in place of damping_ratio; zeros for that of bandwidth",
        "N m s/rad",
        shape=(3,),
        default=(0.0, 0.0, 0.0),
        least=0.0,
        most=1e9,
    )
    integral_rate: float = number(
        "integral action: stiffness times this is the torque per sum of errors; 0 for none",
        "1/s",
        default=0.0,
        least=0.0,
        most=1e6,
    )
    torque_limit: float = number(
        "largest torque that is commanded, beside that of the scene's actuators; 0 for none",
        "N m",
        default=0.0,
        least=0.0,
        most=1e9,
    )
    feedforward_at: str = choice(
        "instant of a control period whose feedforward is held over it",
        INSTANTS,
        default="start",
    )

    def check(self) -> Iterator[Problem]:
        """Refuse gains of a joint where there is none."""
        if self.direct and self.mode == "computed_torque" and self.space == "so3":
            allowed = "is a joint's: on so3 give bandwidth and damping_ratio"
            yield Problem("stiffness", self.stiffness, allowed)
        if self.direct and not any(self.stiffness) and self.integral_rate:
            yield Problem("integral_rate", self.integral_rate, "acts on stiffness: give it")

    @property
    def direct(self) -> bool:
        """Whether the gains are given as such, and not by bandwidth."""
        return any(self.stiffness) or any(self.damping)


class ControlStopped(SstError):
    """No torque can be computed; every later call raises the same until a reset.

    Attributes:
        time: of the motion [s].

    """

    def __init__(self, reason: str, time: float) -> None:
        self.time = time
        super().__init__(f"control stopped at t = {time:.9f} s: {reason}")


@dataclass(frozen=True)
class Measurement:
    """Angles [rad] and rates [rad/s] of the actuators, as encoders measure them."""

    gamma: Vector3
    gamma_dot: Vector3


@dataclass(frozen=True)
class Command:
    """Output of a controller at one instant.

    Attributes:
        torque: command [N m]: feedforward + feedback, limited.
        feedforward: torque of the model without an error [N m]; gravity_pd: gravity compensation.
        feedback: torque due to the error [N m].
        desired: the reference at this instant.
        saturated: a torque was limited.

    """

    torque: Vector3
    feedforward: Vector3
    feedback: Vector3
    desired: Reference
    saturated: bool


class Controller:
    """A controller that tracks one reference motion by one of the five schemes above.

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
        self._inverse = InverseDynamics(model)
        self._observer = OrientationObserver(geometry, start.quaternion, start.gamma)
        posture = virtual_work.posture(
            geometry, np.array(start.gamma), rotation_matrix(start.quaternion)
        )
        t1, _ = virtual_work.equation_of_motion(
            virtual_work.Mechanism.of(model), posture, (0.0, 0.0, 0.0)
        )
        self.inertia = _three(-np.diag(t1))
        self._kp, self._kd = self._gains()
        limits = [settings.torque_limit or math.inf]
        if model.actuators is not None:
            limits.append(model.actuators.torque_limit or math.inf)
        self._limit = min(limits)
        self.reset()

    def reset(self) -> None:
        """Clear the integral, the observer and a failure."""
        self._observer.reset()
        self._sum: Vector3 = ZERO
        self._failure: ControlStopped | None = None

    def follow(self, motion: ReferenceMotion) -> None:
        """Track another motion, from the present reference on; gains and integral stay."""
        self._motion = motion

    def command(self, time: float, measured: Measurement) -> Command:
        """Return the command at a time of the motion [s], to be held for a period.

        Raises:
            ControlStopped: the measurement is not finite, the assembly mode ends, or the model is
                singular there.

        """
        if self._failure is not None:
            raise self._failure
        try:
            return self._command(time, measured)
        except (SstError, ArithmeticError, ValueError) as error:
            self._failure = ControlStopped(str(error), time)
            raise self._failure from error

    def __call__(self, time: float, state: State) -> Vector3:
        """Torques [N m] for the angles and rates of a state: a function for `simulate`."""
        joints = state.joints
        return self.command(time, Measurement(joints.gamma, joints.gamma_dot)).torque

    def _command(self, time: float, measured: Measurement) -> Command:
        _require_finite((*measured.gamma, *measured.gamma_dot), "measured")
        mode, desired = self._settings.mode, self._motion.at(time)
        error = axpy(1.0, desired.gamma, -1.0, measured.gamma)
        feedforward, feedback = ZERO, ZERO
        if mode == "gravity_pd":
            feedforward = self._inverse.gravity_torque(self._observer.update(measured.gamma))
        elif mode != "pd":
            feedforward = self._inverse.reference_torque(desired)
        summed: Vector3 = ZERO
        if mode == "computed_torque":
            total, summed = self._compute_torque(desired, measured, error)
            feedback = axpy(1.0, total, -1.0, feedforward)
        elif mode != "feedforward":
            rates = axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot)
            acceleration, summed = self._feedback(error, rates)
            feedback = _by_joint(self.inertia, acceleration)
        if self._settings.feedforward_at == "middle" and mode not in ("pd", "gravity_pd"):
            feedforward = self._inverse.reference_torque(
                self._motion.at(time + 0.5 * self._period_s)
            )
        return self._finish(feedforward, feedback, desired, error, summed)

    def _finish(
        self,
        feedforward: Vector3,
        feedback: Vector3,
        desired: Reference,
        error: Vector3,
        summed: Vector3,
    ) -> Command:
        total = add(feedforward, feedback)
        _require_finite(total, "torque")
        torque = clamp(total, self._limit)
        if dot(axpy(1.0, total, -1.0, torque), error) <= 0.0:
            self._sum = axpy(1.0, self._sum, self._period_s, summed)
        return Command(torque, feedforward, feedback, desired, torque != total)

    def _compute_torque(
        self, desired: Reference, measured: Measurement, error: Vector3
    ) -> tuple[Vector3, Vector3]:
        """Torque of computed_torque, and the error to integrate."""
        quaternion = self._observer.update(measured.gamma)
        rates = axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot)
        acceleration, summed = self._feedback(error, rates)
        now = self._observer.coordinates.of_actuators(
            quaternion, measured.gamma, measured.gamma_dot, add(desired.gamma_ddot, acceleration)
        )
        body_acceleration = now.body_acceleration
        if self._settings.space == "so3":
            body_acceleration, summed = self._on_so3(desired, now)
        return self._inverse.torque(now.quaternion, now.body_rate, body_acceleration), summed

    def _on_so3(self, desired: Reference, now: Reference) -> tuple[Vector3, Vector3]:
        """W_dot in {E}, and the rotation vector of the error, which is integrated."""
        between = relative_quaternion(now.quaternion, desired.quaternion)
        turn = rotation_rows(between)
        rate, forward = (
            _three(dot(row, vector) for row in turn)
            for vector in (desired.body_rate, desired.body_acceleration)
        )
        moving = axpy(1.0, forward, -1.0, cross(now.body_rate, rate))
        phi = rotation_vector(between)
        acceleration, summed = self._feedback(phi, axpy(1.0, rate, -1.0, now.body_rate))
        return add(moving, acceleration), summed

    def _feedback(self, error: Vector3, rates: Vector3) -> tuple[Vector3, Vector3]:
        """Acceleration kp e + kd e_dot with integral action, and the error to integrate."""
        leaning = axpy(1.0, error, self._settings.integral_rate, self._sum)
        return add(_by_joint(self._kp, leaning), _by_joint(self._kd, rates)), error

    def _gains(self) -> tuple[Vector3, Vector3]:
        """Gains kp [1/s^2] and kd [1/s] of accelerations."""
        given, of = self._settings, self.inertia
        if given.direct:
            kp = _three(np.divide(given.stiffness, of))
            kd = _three(np.divide(given.damping, of))
        else:
            kp = multiply(given.bandwidth**2, (1.0, 1.0, 1.0))
            kd = multiply(2.0 * given.damping_ratio * given.bandwidth, (1.0, 1.0, 1.0))
        # Routh: s^3 + kd s^2 + kp s + kp r is stable for 0 < r < kd.
        if given.integral_rate >= min(kd) and given.integral_rate > 0.0:
            allowed = f"must be < {min(kd):g} 1/s, damping over inertia: else the loop is unstable"
            raise InputError("control", [Problem("integral_rate", given.integral_rate, allowed)])
        return kp, kd


def rotation_vector(quaternion: Quaternion) -> Vector3:
    """Axis times angle, 0 to pi [rad], of a rotation; exact for tiny angles."""
    sign = math.copysign(1.0, quaternion[3])
    x, y, z, w = (sign * part for part in quaternion)
    sine = math.hypot(x, y, z)
    factor = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
    return factor * x, factor * y, factor * z


def _three(values: Iterable[float]) -> Vector3:
    first, second, third = map(float, values)
    return first, second, third


def _by_joint(factors: Vector3, values: Vector3) -> Vector3:
    return factors[0] * values[0], factors[1] * values[1], factors[2] * values[2]


def _require_finite(numbers: Sequence[float], what: str) -> None:
    if not all(map(math.isfinite, numbers)):
        raise InputError("control", [Problem(what, tuple(numbers), "must be finite numbers")])
