# SPDX-License-Identifier: Apache-2.0
"""Functions of one scene, traced: those that a run calls, and the ODE that is integrated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from itertools import chain
from typing import Any

import numpy as np

from sst_ros.dynamics import kernel
from sst_ros.dynamics.expression import (
    Program,
    Slots,
    compile_program,
    number_constants,
    trace,
    with_jacobian,
)
from sst_ros.dynamics.model import Limit
from sst_ros.mechanism.generic_math import Scalar, positive, sin
from sst_ros.mechanism.geometry import Array
from sst_ros.scene.loads import SineTorque
from sst_ros.scene.scene import Scene

Function = Callable[..., tuple[float, ...]]

QUATERNION = ("x", "y", "z", "w")
RATE = ("wx", "wy", "wz")
LAG = ("l1", "l2", "l3")
TORQUE = ("t1", "t2", "t3")
MOMENT = ("n1", "n2", "n3")
BODY_ACCELERATION = ("ax", "ay", "az")

_LANES = 4
"""The loop over the columns of a Jacobian is a multiple of this long: numbers in a register."""


class Dynamics:
    """Programs of a manipulator with the constants `model`, numbers or not.

    `state` has the names of the state's numbers: quaternion, body rate, lagged torques if any;
    `drive` of what acts from outside: torques, and a moment if it comes from a topic.
    """

    def __init__(self, model: kernel.Model, *, has_moment_topic: bool = False) -> None:
        self.model, self.has_moment_topic = model, has_moment_topic
        lagging = model.time_constant is not None
        self.state = (*QUATERNION, *RATE, *(LAG if lagging else ()))
        self.drive = (*TORQUE, *(MOMENT if has_moment_topic else ()))

    @staticmethod
    def of(scene: Scene) -> Dynamics:
        """Give those of a scene: traced once for all scenes that have the same constants."""
        has_moment_topic = scene.moment is not None and scene.moment.topic
        return recent(kernel.model_of(scene), has_moment_topic=has_moment_topic)

    @cached_property
    def program(self) -> Program:
        """Derivative of the state by time; inputs are state and drive."""
        function = partial(kernel.derivative, self.numbers)
        return trace(lambda *given: function(*self._split(given)), (*self.state, *self.drive))

    @cached_property
    def derivative(self) -> Function:
        """The program as a function of plain floats."""
        return compile_program(self.program)

    @cached_property
    def joints(self) -> Function:
        """Angles gamma, mu, beta and rates in the same order, 18 numbers of the first seven."""
        return compile_program(self.joints_program)

    @cached_property
    def joints_program(self) -> Program:
        """The program of `joints`."""
        joints = partial(kernel.joints, self.numbers)
        return trace(lambda *state: [*chain(*joints(state))], (*QUATERNION, *RATE))

    @cached_property
    def inverse(self) -> Function:
        """Torques that give a W_dot, det g and sin^2(mu_k), 7 numbers: `kernel.actuator_torque`.

        Of the first seven numbers of the state, W_dot, and a moment if it comes from a topic.
        """

        def torques(*inputs: Any) -> tuple[Any, ...]:
            q, rate, acceleration, moment = inputs[:4], inputs[4:7], inputs[7:10], inputs[10:]
            found = kernel.actuator_torque(self.model, q, rate, acceleration, moment or None)
            return (*found[0], found[1], *(at.u for at in kernel.leg_motions(self.model, inputs)))

        more = MOMENT if self.has_moment_topic else ()
        return compile_program(trace(torques, (*QUATERNION, *RATE, *BODY_ACCELERATION, *more)))

    @cached_property
    def energies(self) -> Function:
        """Kinetic and potential energy [J] and power put in [W], of state and drive."""

        def energies(*inputs: Any) -> tuple[Any, ...]:
            given = self._split(inputs)
            kinetic = kernel.kinetic_energy(self.model, given[0])
            potential = kernel.potential_energy(self.model, given[0])
            return kinetic, potential, kernel.power(self.model, *given)

        return compile_program(trace(energies, (*self.state, *self.drive)))

    def total_energy(self, state: Sequence[float]) -> float:
        """Kinetic and potential energy [J] of a state, whose further numbers are not looked at."""
        kinetic, potential, _ = self.energies(*state[: len(self.state)], *(0.0,) * len(self.drive))
        return kinetic + potential

    @cached_property
    def numbers(self) -> kernel.Model:
        """The model, in which what is not 0 or 1 may have another value in another scene."""
        model: kernel.Model = number_constants(self.model, ("model",))
        return model

    def _split(self, inputs: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        size = len(self.state)
        return inputs[:size], inputs[size : size + 3], inputs[size + 3 :] or None


recent = lru_cache(maxsize=32)(Dynamics)


class ODE:
    """Derivative of a scene's state, as programs with the inputs t, state, drive.

    `torque` over time, clamped to `limit` [N m], replaces the torques of the drive; with `phases`
    the drive keeps three numbers for them, the phases [rad]. `work` appends to the state the work
    [J] that actuators and moments have put in, less what friction has taken out.

    `state` has the names of the state's numbers: quaternion, body rate, lagged torques, work;
    `drive` of what acts from outside and is constant over a step.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        torque: SineTorque | None = None,
        *,
        limit: float | None = None,
        work: bool = False,
        phases: bool = False,
    ) -> None:
        self._dynamics, self._torque, self._limit = dynamics, torque, limit
        self._work, self._phases = work, phases
        self.state = (*dynamics.state, *(("work",) if work else ()))
        self.drive = dynamics.drive if torque is None or phases else dynamics.drive[3:]
        self._inputs = ("t", *self.state, *self.drive)

    @cached_property
    def program(self) -> Program:
        """The derivative."""
        return trace(self._of_numbers, self._inputs)

    @cached_property
    def jacobian(self) -> Program:
        """The derivative, and its derivatives by t and by each number of the state."""
        return with_jacobian(self._of_numbers, self._inputs, ("t", *self.state))

    @cached_property
    def directional(self) -> Program:
        """The derivative, and its own along the direction d_x, .. of further inputs."""
        return with_jacobian(self._of_numbers, self._inputs, (), self._variables)

    def linearise_by_columns(self, slots: Slots) -> str:
        """Source of `linearise` for numba: all columns of the Jacobian in a loop over directions.

        It is half as long as the operations of each column in a row, which takes half the time to
        compile, and the compiler takes four columns at once; the digits are those of the columns.

            def linearise(t, state, d, p, slope, by_time, matrix):
                x = state[0]
                t1 = d[0]
                c0 = p[0]
                v0 = x * x
                slope[0] = v7
                columns = vector(64)
                for k in range(8):
                    d_x = 1.0 if k == 0 else 0.0
                    v8 = d_x * v0
                    columns[0 + k] = v9
                for i in range(8):
                    by_time[i] = columns[8 * i + 7]
                    for k in range(7):
                        matrix[i][k] = columns[8 * i + k]
        """
        size, variables = len(self.state), self._variables
        directions = [f"d_{name}" for name in variables]
        lines, results = self.directional.body(slots)
        inner = self.directional.steps_of(directions)
        width = -(-len(variables) // _LANES) * _LANES
        states = len(variables) - ("t" in variables)
        body = [
            *(f"{name} = state[{i}]" for i, name in enumerate(self.state)),
            *(f"{name} = d[{i}]" for i, name in enumerate(self.drive)),
            *slots.reads([*lines, *results]),
            *(line for line, along in zip(lines, inner, strict=True) if not along),
            *(f"slope[{i}] = {result}" for i, result in enumerate(results[:size])),
            f"columns = vector({size * width})",
            f"for k in range({width}):",
            *(f"    {name} = 1.0 if k == {k} else 0.0" for k, name in enumerate(directions)),
            *(f"    {line}" for line, along in zip(lines, inner, strict=True) if along),
            *(f"    columns[{i * width} + k] = {x}" for i, x in enumerate(results[size:])),
            f"for i in range({size}):",
            *([f"    by_time[i] = columns[{width} * i + {states}]"] if "t" in variables else []),
            f"    for k in range({states}):",
            f"        matrix[i][k] = columns[{width} * i + k]",
        ]
        head = "def linearise(t, state, d, p, slope, by_time, matrix):"
        return "\n    ".join([head, *body]) + "\n"

    @property
    def _variables(self) -> tuple[str, ...]:
        """What the derivative depends on: the state but the work, and the time under a torque."""
        state = self.state[:-1] if self._work else self.state
        return state if self._torque is None else (*state, "t")

    def eigenvalues(self, t: float, y: Sequence[float], d: Sequence[float]) -> Array:
        """Eigenvalues of the exact Jacobian at time [s], state and drive [1/s], shape (size,).

        Where it is not finite, ArithmeticError or ValueError is raised.
        """
        size = len(self.state)
        flat = np.array(self.linearised(t, *y, *d)[2 * size :])
        return np.asarray(np.linalg.eigvals(flat.reshape(size, size).T))

    @cached_property
    def linearised(self) -> Function:
        """The program of `jacobian` as a function."""
        return compile_program(self.jacobian)

    @cached_property
    def linearised_by_torque(self) -> Function:
        """The derivative, and its derivatives by t, the state and the torques of the drive."""
        by = ("t", *self.state, *TORQUE)
        return compile_program(with_jacobian(self.derivative, self._inputs, by))

    @property
    def joints(self) -> Program:
        """Nine angles and nine rates, of quaternion and body rate."""
        return self._dynamics.joints_program

    def derivative(self, time: Any, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative at the time, the state and the drive given, of any kind."""
        return self._slope((self._dynamics.model, self._torque, self._limit), time, *inputs)

    def _of_numbers(self, *inputs: Any) -> tuple[Any, ...]:
        """Return the derivative with numbers that may be others in another scene."""
        torque = number_constants(self._torque, ("torque",))
        limit = number_constants(self._limit, ("limit",))
        return self._slope((self._dynamics.numbers, torque, limit), *inputs)

    def _slope(self, constants: tuple[Any, Any, Any], time: Any, *inputs: Any) -> tuple[Any, ...]:
        model, sine, limit = constants
        state, drive = inputs[: len(self._dynamics.state)], inputs[len(self.state) :]
        torque, moment = drive[:3], drive[3:]
        if sine is not None:
            phase = torque if self._phases else sine.phase
            moment = moment if self._phases else drive
            rows = zip(sine.amplitude, sine.frequency, phase, strict=True)
            torque = tuple(a * sin(f * time + p) for a, f, p in rows)
            if limit is not None:
                torque = tuple(_clamp(tau, limit) for tau in torque)
        slope = kernel.derivative(model, state, torque, moment or None)
        work = (kernel.power(model, state, torque, moment or None),) if self._work else ()
        return (*slope, *work)


def _clamp(torque: Any, limit: float) -> Any:
    """Clamp a torque, of any kind of number."""
    return limit - positive(2.0 * limit - positive(torque + limit))


@lru_cache(maxsize=32)
def ode_with_work(dynamics: Dynamics) -> ODE:
    """Give the system that counts work: traced once for all runs of the same dynamics."""
    return ODE(dynamics, work=True)


@lru_cache(maxsize=32)
def ode_under(dynamics: Dynamics, torque: SineTorque, limit: float | None) -> ODE:
    """Give the system under a sine whose phases are its drive, which counts work."""
    return ODE(dynamics, torque, limit=limit, work=True, phases=True)


def limit_distances(
    limits: Sequence[Limit],
    ends: Sequence[tuple[Scalar, Scalar]],
    model: kernel.Model,
    state: Sequence[Any],
) -> tuple[Scalar, ...]:
    """Return a number for each limit, positive inside, then the rate of each.

    They hold for angles less than pi away from the limit. `ends` has cosine and sine of the end of
    each limit; the state is quaternion and body rate.
    """
    legs = list(kernel.leg_motions(model, state))
    pairs = [
        _distance(limit, *end, legs[limit.joint % 3])
        for limit, end in zip(limits, ends, strict=True)
    ]
    return tuple(pair[0] for pair in pairs) + tuple(pair[1] for pair in pairs)


def _distance(
    limit: Limit, cosine: Scalar, sine: Scalar, at: kernel.LegMotion
) -> tuple[Scalar, Scalar]:
    """sqrt(u) sin(sign * (angle - end)) and its rate; of mu sin(mu)^2 - sin(end)^2."""
    kind = limit.joint // 3
    if kind == 1:
        return at.u - sine * sine, -2.0 * at.a * at.a_dot
    across, along = kernel.direction_of(at, kind)
    distance = limit.sign * (across * cosine - along * sine)
    turning = limit.sign * (along * cosine + across * sine) * kernel.joint_rate(at, kind)
    return distance, turning - distance * at.a * at.a_dot / at.u
