# SPDX-License-Identifier: Apache-2.0
"""Controllers that track a reference motion: by the model, by feedback, or by both; see `law`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sst_ros.control.actuator_space import ActuatorSpaceMap, Reference, ReferenceMotion
from sst_ros.control.inverse_dynamics import InverseDynamics
from sst_ros.control.law import (
    Command,
    ControlLaw,
    ControllerSettings,
    command_limit,
    feedback_gains,
)
from sst_ros.errors import SstError, refuse_unless
from sst_ros.mechanism import virtual_work
from sst_ros.mechanism.generic_math import ZERO, triple
from sst_ros.mechanism.geometry import Geometry, rotation_matrix
from sst_ros.scene.scene import Scene
from sst_ros.state import State, Vector3


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
