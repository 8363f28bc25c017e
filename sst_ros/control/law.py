# SPDX-License-Identifier: Apache-2.0
"""The control law, and the channel of plant and controller, on numbers of any kind.

The five schemes, with e = desired - measured in gamma:

    feedforward         tau = ID(desired)
    pd                  tau = K e + D e_dot
    gravity_pd          tau = K e + D e_dot + G(measured)      Takegaki and Arimoto 1981
    feedforward_pd      tau = ID(desired) + K e + D e_dot
    computed_torque     tau = ID(measured state, gamma_ddot + kd e_dot + kp e)

ID is the inverse dynamics (Eq. 90) with all terms of the model, G its gravity torque.

On SO(3) the error of computed_torque is the rotation vector phi = log(R^T R_d) in {E},
and W_dot = d/dt(R^T R_d W_d) + kd e_W + kp phi with e_W = R^T R_d W_d - W. As phi is an
eigenvector of its own differential, kp phi^2 + e_W^2 falls at the rate 2 kd e_W^2 from
every error below half a turn (Bullo and Murray 1995).

Integral action adds K r times the integral of e. It is frozen while a torque is at its
limit and the error would drive it further (conditional integration, Astrom and Hagglund
2006, section 3.5).

Floats make it the law of a `Controller`, traced numbers the compiled loop of a batch:
it branches on settings, never on numbers.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import Reference
from sst_ros.mechanism import generic_math as gm
from sst_ros.mechanism.generic_math import Quadruple, Scalar, Triple, add, axpy, triple
from sst_ros.scene.scene import Scene
from sst_ros.scene.schema import Rules, Section, choice, coefficient, entry, positive
from sst_ros.state import ZERO, Array, Vector3, clamp

MODES = ("feedforward", "feedforward_pd", "computed_torque", "pd", "gravity_pd")
SPACES = ("gamma", "so3")
HELD_INSTANTS = ("start", "middle")
# Added and subtracted, it rounds to whole numbers, halves to even: traced numbers have
# no function that does.
_ROUND = 1.5 * 2.0**52
# Added to the square of a sine, it keeps a division by 0 away and changes no other.
_TINY_SQUARE = 1e-300


def _joint_gain(name: str, unit: str, instead: str) -> Any:
    doc = f"{name} of the feedback, in place of {instead}; zeros for that of bandwidth"
    return entry(doc, unit, default=ZERO, least=0.0, most=1e9)


class ControllerSettings(Section):
    """Mode and gains.

    Gains are of a joint, tau_k = stiffness_k e_k + damping_k e_dot_k with e = desired -
    measured. By bandwidth they are those of the inertia M_kk that joint k has at the
    start of the motion: stiffness M_kk bandwidth^2, damping 2 damping_ratio M_kk
    bandwidth; so pd, gravity_pd and feedforward_pd have equal gains. computed_torque
    takes them over M_kk, as accelerations.
    """

    mode: str = choice(
        "feedforward: torque of the desired motion; feedforward_pd: and feedback;"
        " computed_torque: the model at the measured state, and feedback; pd: feedback"
        " alone; gravity_pd: and the weight at the measured position",
        MODES,
    )
    space: str = choice(
        "where computed_torque is linear: the actuator angles, or the orientation",
        SPACES,
    )
    bandwidth: float = positive(
        "natural frequency of the error", "rad/s", default=30.0, most=1e6
    )
    damping_ratio: float = positive(
        "damping ratio of the error", "1", default=1.0, most=1e3
    )
    stiffness: Vector3 = _joint_gain("stiffness", "N m/rad", "bandwidth")
    damping: Vector3 = _joint_gain("damping", "N m s/rad", "damping_ratio")
    integral_rate: float = coefficient(
        "integral action: stiffness times this is the torque per sum of errors; 0 for"
        " none",
        "1/s",
        most=1e6,
    )
    torque_limit: float = coefficient(
        "largest torque that is commanded, beside that of the scene's actuators; 0 for"
        " none",
        "N m",
        most=1e9,
    )
    feedforward_at: str = choice(
        "instant of a control period whose feedforward is held over it", HELD_INSTANTS
    )

    def rules(self) -> Rules:
        """Refuse gains of a joint where there is none."""
        alone = self.direct and self.mode == "computed_torque" and self.space == "so3"
        requirement = "is a joint's: on so3 give bandwidth and damping_ratio"
        yield alone, "stiffness", self.stiffness, requirement
        idle = self.direct and not any(self.stiffness) and self.integral_rate
        yield idle, "integral_rate", self.integral_rate, "acts on stiffness: give it"

    @property
    def direct(self) -> bool:
        """Whether the gains are given as such, and not by bandwidth."""
        return any(self.stiffness) or any(self.damping)

    @property
    def feeds(self) -> bool:
        """Whether the torque of the desired motion is fed forward."""
        return self.mode not in ("pd", "gravity_pd")

    @property
    def observes(self) -> bool:
        """Whether the law needs the orientation, observed by the measured angles."""
        return self.mode in ("gravity_pd", "computed_torque")


class Measurement(NamedTuple):
    """Angles [rad] and rates [rad/s] of the actuators, as encoders measure them."""

    gamma: Vector3
    gamma_dot: Vector3


class ControlChannel(Section):
    """What lies between plant and controller; zeros change nothing.

    Until the first of what is delayed arrives it is there already. An encoder measures
    no rate: that is the difference of its last two angles over the period. Noise is new
    at every sample.
    """

    period: float = entry("control period", "s", default=1e-3, least=1e-6, most=1.0)
    delay: int = entry("delay of commands", "periods", default=0, least=0, most=100)
    counts: int = entry(
        "encoder steps per turn; 0 for exact angles and rates",
        "1",
        default=0,
        least=0,
        most=2**31,
    )
    angle_noise: float = coefficient(
        "standard deviation of noise on gamma", "rad", most=1.0
    )
    rate_noise: float = coefficient(
        "standard deviation of noise on gamma_dot", "rad/s", most=1e3
    )

    def count(self, angle: Scalar) -> Scalar:
        """Round an angle [rad] to the steps of the encoders."""
        step = 2.0 * math.pi / self.counts
        return step * ((angle / step + _ROUND) - _ROUND)

    def measure(
        self, gamma: Triple, gamma_dot: Triple, before: Any, noise: Any
    ) -> tuple[Measurement, Any]:
        """Return what the controller receives of gamma [rad] and gamma_dot [rad/s].

        With it come the angles to remember: `before` are those of the last sample, none
        without encoders. `noise` are six numbers that are added to gamma [rad] and
        gamma_dot [rad/s], or none.
        """
        if self.counts:
            gamma = triple(map(self.count, gamma))
            moved = axpy(1.0, gamma, -1.0, before)
            gamma_dot = triple(difference / self.period for difference in moved)
            before = gamma
        if noise:
            *angle_noise, first, second, third = noise
            gamma = add(gamma, triple(angle_noise))
            gamma_dot = add(gamma_dot, (first, second, third))
        return Measurement(gamma, gamma_dot), before

    def transmit(
        self, command: Triple, queue: Any, first: Scalar
    ) -> tuple[Triple, Any]:
        """Return the command that acts, and the queue behind it.

        The queue has three numbers for each period of `delay`. `first` is 1 at the
        first sample, else 0.
        """
        # At the first sample copies of the command fill the queue. A product chooses
        # them, not a branch: in the loop of a batch `first` is a traced number.
        copies = command * self.delay
        waiting = []
        for copied, queued in zip(copies, queue, strict=True):
            waiting.append(first * copied + (1.0 - first) * queued)
        torque_1, torque_2, torque_3, *new_queue = (*waiting, *command)
        return (torque_1, torque_2, torque_3), tuple(new_queue)


@dataclass(frozen=True)
class Command:
    """What the law answers at a sample."""

    torque: Vector3  # the command [N m]: feedforward + feedback, limited
    feedforward: Vector3  # what the model needs without an error [N m]
    feedback: Vector3  # due to the error [N m]
    desired: Reference
    error: Vector3  # desired - measured gamma [rad]
    error_rate: Vector3  # desired - measured gamma_dot [rad/s]
    integral: Any  # the new sum of errors [rad s]
    total: Vector3  # the command before it is limited [N m]

    @property
    def saturated(self) -> bool:
        """Whether a torque was limited."""
        return self.torque != self.total


def is_above(value: Scalar) -> Scalar:
    """Return 1 where a number is positive, else 0."""
    return value.apply("step") if hasattr(value, "apply") else float(value > 0.0)


def rotation_vector(quaternion: Quadruple) -> Triple:
    """Axis times angle, 0 to pi [rad], of a rotation; exact for tiny angles."""
    *_, real = quaternion
    sign = 2.0 * is_above(real) - 1.0
    x, y, z, w = (sign * component for component in quaternion)
    sine = gm.sqrt(x * x + y * y + z * z + _TINY_SQUARE)
    factor = 2.0 * gm.atan2(sine, w) / sine
    return factor * x, factor * y, factor * z


class ControlLaw(NamedTuple):
    """The law of some settings, and its numbers; by joint where there are three.

    The model is two functions: `torque` gives torques [N m] by quaternion, W and W_dot,
    `accelerate` W and W_dot as `ActuatorSpaceMap.star_motion` does.
    """

    settings: ControllerSettings
    torque: Callable[[Any, Any, Any], Triple]
    accelerate: Callable[..., Any]
    kp: Triple  # gains of accelerations [1/s^2]
    kd: Triple  # [1/s]
    inertia: Triple  # M_kk at the start of the motion [kg m^2]
    integral_rate: Scalar  # [1/s]
    limit: Scalar | None  # of commands [N m]
    period: float  # from one sample to the next [s]
    # axis times angle [rad] of a quaternion
    turn: Callable[[Quadruple], Triple] = rotation_vector

    def answer(
        self,
        desired: Reference,
        torques: Sequence[Triple],
        measured: Measurement,
        observed: Any,
        integral: Any,
        effort: Triple | None = None,
    ) -> Command:
        """Return the torques at a sample, of the measured angles and rates.

        Args:
            desired: where the motion is to be.
            torques: those of the desired motion [N m], now and at the instant whose
                torque is held.
            measured: the angles [rad] and rates [rad/s].
            observed: the orientation at the measured angles, where the law needs it.
            integral: the sum of errors [rad s], none without integral action.
            effort: torques [N m] that are added to the feedforward.

        """
        mode = self.settings.mode
        present_torque, held_torque = torques
        feedforward = held_torque if self.settings.feeds else ZERO
        feedback: Triple = ZERO
        summed: Triple = ZERO  # what the integral sums
        error = axpy(1.0, desired.gamma, -1.0, measured.gamma)
        error_rate = axpy(1.0, desired.gamma_dot, -1.0, measured.gamma_dot)
        if mode == "gravity_pd":
            feedforward = self.torque(observed, ZERO, ZERO)
        if mode == "computed_torque":
            correction = self._correct(integral, error, error_rate)
            gamma_ddot = add(desired.gamma_ddot, correction)
            star_motion = self.accelerate(*observed, *measured.gamma_dot, *gamma_ddot)
            wx, wy, wz, *acceleration = star_motion
            body_rate = (wx, wy, wz)
            acceleration = triple(acceleration)
            summed = error
            if self.settings.space == "so3":
                summed, acceleration = self._correct_on_so3(
                    desired, observed, body_rate, integral
                )
            needed = self.torque(observed, body_rate, acceleration)
            feedback = axpy(1.0, needed, -1.0, present_torque)
        elif mode != "feedforward":
            summed = error
            correction = self._correct(integral, error, error_rate)
            feedback = _by_joint(self.inertia, correction)
        if effort is not None:
            feedforward = add(feedforward, effort)
        total = add(feedforward, feedback)
        torque = total
        weight: Scalar = 1.0  # 0 where the integral is frozen
        if self.limit is not None:
            torque = bound(total, self.limit)
            weight = 1.0 - is_above(gm.dot3(excess(total, self.limit), error))
        if integral:
            integral = axpy(1.0, integral, weight * self.period, summed)
        return Command(
            torque=torque,
            feedforward=feedforward,
            feedback=feedback,
            desired=desired,
            error=error,
            error_rate=error_rate,
            integral=integral,
            total=total,
        )

    def _correct_on_so3(
        self, desired: Reference, observed: Any, body_rate: Triple, integral: Any
    ) -> tuple[Triple, Triple]:
        """Error on SO(3) [rad], and W_dot [rad/s^2] that makes it vanish."""
        x, y, z, w = observed
        to_desired = gm.quaternion_product((-x, -y, -z, w), desired.quaternion)
        rows = gm.rotation_rows(to_desired)  # of R^T R_d
        rate = triple(gm.dot3(row, desired.body_rate) for row in rows)
        acceleration = triple(gm.dot3(row, desired.body_acceleration) for row in rows)
        # d/dt(R^T R_d W_d)
        feedforward = axpy(1.0, acceleration, -1.0, gm.cross3(body_rate, rate))
        error = self.turn(to_desired)
        error_rate = axpy(1.0, rate, -1.0, body_rate)
        return error, add(feedforward, self._correct(integral, error, error_rate))

    def _correct(self, integral: Any, error: Triple, error_rate: Triple) -> Triple:
        """Acceleration kp e + kd e_dot, with integral action."""
        error_and_sum = error
        if integral:
            error_and_sum = axpy(1.0, error, self.integral_rate, integral)
        return add(_by_joint(self.kp, error_and_sum), _by_joint(self.kd, error_rate))


def _by_joint(factors: Triple, values: Triple) -> Triple:
    return triple(map(operator.mul, factors, values))


def feedback_gains(
    inertia: Array, value: Callable[[str], Any], direct: bool
) -> tuple[Array, Array]:
    """Return gains kp [1/s^2] and kd [1/s] of accelerations, shape (3, n).

    The inertia is M_kk, shape (3, 1); `value` is that of a field of
    `ControllerSettings`, for n loops or for all of them; gains are `direct` where
    stiffness and damping are given.
    """
    if direct:
        stiffness = np.reshape(value("stiffness"), (3, -1))
        damping = np.reshape(value("damping"), (3, -1))
        return stiffness / inertia, damping / inertia
    ones = np.ones_like(inertia)
    bandwidth = value("bandwidth")
    return ones * bandwidth**2, ones * (2.0 * value("damping_ratio") * bandwidth)


def command_limit(limit: Any, model: Scene) -> Array:
    """Return the limit of commands [N m]: that of the settings, or of the actuators.

    The smaller one counts; 0 in the settings, or None of the actuators, is no limit.
    """
    of_settings = np.where(np.asarray(limit) > 0.0, limit, np.inf)
    of_actuators = model.torque_limit or np.inf
    return np.minimum(of_settings, of_actuators)


def bound(values: Triple, limit: Scalar) -> Triple:
    """Clamp three numbers to the interval from -limit to limit."""
    if isinstance(limit, float):
        return clamp(values, limit)
    return triple(x - gm.positive(x - limit) + gm.positive(-limit - x) for x in values)


def excess(values: Triple, limit: Scalar) -> Triple:
    """Return what `bound` takes from three numbers: zeros inside of the limit."""
    return triple(gm.positive(x - limit) - gm.positive(-limit - x) for x in values)
